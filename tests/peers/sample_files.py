"""Writes the same samples in every format that `hear` reads or that launch/SAMPLES.md converts, and converts those.

    sample_files.py DIR SAMPLES.md

SAMPLES.md is the document whose Python blocks are run. Leaves text.uff, binary.uff, test.csv, test.mf4,
test.tdms, test.h5 and the converted mf4.wav, tdms.wav, h5.wav in DIR, and reference.wav. Prints the versions of the
packages and the files that were written; a package that is missing leaves out its files.
"""

import importlib.util
import json
import os
import re
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import scipy.io.wavfile

RATE_HZ = 51_200
DURATION_S = 1.5


def samples() -> np.ndarray:
    """A tone of 3210.5 Hz and 0.5 Pa from 0.5 to 1 s in noise of 1 mPa, in Pa."""
    t = np.arange(int(DURATION_S * RATE_HZ)) / RATE_HZ
    flank = np.clip(np.minimum(t - 0.5, 1.0 - t) / 0.01, 0.0, 1.0)
    tone = 0.5 * np.sin(0.5 * np.pi * flank) ** 2 * np.sin(2 * np.pi * 3210.5 * t)
    return (tone + 1e-3 * np.random.default_rng(1).normal(size=t.size)).astype(np.float32)


def write_uff(path: Path, data: np.ndarray, binary: bool, double: bool) -> None:
    import pyuff

    dataset = {
        "type": 58,
        "binary": int(binary),
        "id1": "microphone",
        "func_type": 1,
        "rsp_ent_name": "NONE",
        "rsp_node": 1,
        "rsp_dir": 3,
        "ref_ent_name": "NONE",
        "ref_node": 1,
        "ref_dir": 3,
        "ord_data_type": 4 if double else 2,
        "abscissa_spacing": 1,
        "abscissa_spec_data_type": 17,
        "ordinate_spec_data_type": 15,
        "ordinate_axis_units_lab": "Pa",
        "orddenom_spec_data_type": 0,
        "data": data.astype(float),
        "x": np.arange(data.size) / RATE_HZ,
    }
    path.unlink(missing_ok=True)
    # "overwrite" loses the header of a binary dataset.
    pyuff.UFF(str(path)).write_sets(dataset, "add", force_double=double)


def main() -> int:
    folder, document = Path(sys.argv[1]), Path(sys.argv[2]).read_text()
    os.chdir(folder)
    data = samples()
    scipy.io.wavfile.write("reference.wav", RATE_HZ, data)
    with open("test.csv", "w") as file:
        file.write("time [s],microphone [Pa],load [N]\n")
        # repr of a float32 gives its shortest digits.
        file.writelines(f"{k / RATE_HZ:.9f},{value!s},500\n" for k, value in enumerate(data))
    written = ["test.csv"]
    here = [name for name in ("pyuff", "asammdf", "nptdms", "h5py") if importlib.util.find_spec(name)]
    if "pyuff" in here:
        # Binary in double precision only: of single precision pyuff 2.5.8 writes double precision under the wrong header.
        for name, binary in (("text", False), ("binary", True)):
            write_uff(Path(f"{name}.uff"), data, binary, double=binary)
            written.append(f"{name}.uff")
    if "asammdf" in here:
        import asammdf

        mdf = asammdf.MDF(version="4.10")
        times = np.arange(data.size) / RATE_HZ
        mdf.append([asammdf.Signal(samples=data, timestamps=times, name="microphone", unit="Pa")])
        mdf.save("test.mf4", overwrite=True)
    if "nptdms" in here:
        import nptdms

        with nptdms.TdmsWriter("test.tdms") as writer:
            properties = {"wf_increment": 1 / RATE_HZ, "unit_string": "Pa"}
            writer.write_segment([nptdms.ChannelObject("sound", "microphone", data, properties=properties)])
    if "h5py" in here:
        import h5py

        with h5py.File("test.h5", "w") as file:
            file.create_dataset("microphone", data=data).attrs["sample_rate_hz"] = RATE_HZ
    for block in re.findall(r"```python\n(.*?)```", document, re.S):
        package = re.match(r"import (\w+)", block).group(1)
        if package in here:
            exec(compile(block, "SAMPLES.md", "exec"), {})
            written.append(re.search(r'write\("([^"]+)"', block).group(1))
    versions = {name: version("npTDMS" if name == "nptdms" else name) for name in here}
    print(json.dumps({"versions": versions, "written": written}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
