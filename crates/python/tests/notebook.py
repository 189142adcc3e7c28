"""Runs every notebook of examples/ from the beginning; fails at the first cell that raises or gives no output where one
is expected. With a folder as argument, the notebooks are left there with their outputs."""

import pathlib
import sys
import time

import nbclient
import nbformat

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"

for path in sorted(EXAMPLES.glob("*.ipynb")):
    notebook = nbformat.read(path, as_version=4)
    kinds = [output.get("output_type") for cell in notebook.cells for output in cell.get("outputs", [])]
    assert kinds == [], f"{path.name} is stored with outputs: clear them"
    began = time.monotonic()
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": EXAMPLES}}).execute()
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell in cells:
        errors = [output for output in cell.outputs if output.get("name") == "stderr"]
        assert not errors, f"{path.name}: {errors}"
        # A cell that ends with an expression shows it; one that draws shows a picture.
        last = cell.source.strip().splitlines()[-1]
        if not last.startswith((" ", "import ", "for ", "with ", ")")) and " = " not in last:
            assert cell.outputs, f"{path.name}: no output of {last!r}"
    pictures = sum("image/svg+xml" in output.get("data", {}) for cell in cells for output in cell.outputs)
    print(f"{path.name}: {len(cells)} cells, {pictures} figures, {time.monotonic() - began:.1f} s")
    if len(sys.argv) > 1:
        nbformat.write(notebook, pathlib.Path(sys.argv[1]) / path.name)
