"""The Python that README files show runs."""

import pytest
from conftest import ROOT


@pytest.mark.parametrize("name", ["README.md", "crates/python/README.md"])
def test_python_of_a_readme(name):
    blocks = (ROOT / name).read_text().split("```python\n")[1:]
    assert blocks, "no Python"
    for block in blocks:
        exec(compile(block.split("```")[0], name, "exec"), {})
