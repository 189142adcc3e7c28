"""Checks that the message package can be released to rosdistro, with catkin_pkg, which bloom and colcon read it with.

    message_package.py REPOSITORY

Prints one line of JSON. Run it with the `ros-python` that setup.sh installs.
"""

import json
import re
import sys
import tomllib
from pathlib import Path

from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package


def main() -> int:
    repository = Path(sys.argv[1])
    folder = repository / "msgs"
    package = parse_package(str(folder))
    problems: list[str] = []
    package.validate(warnings=problems)
    version = tomllib.loads((repository / "Cargo.toml").read_text())["workspace"]["package"]["version"]
    if package.version != version:
        problems.append(f"package.xml has version {package.version}, Cargo.toml {version}")
    for licence in package.licenses:
        file = getattr(licence, "file", None)
        if not file or not (folder / file).is_file():
            problems.append(f"licence {licence}: no file")
        elif (folder / file).read_bytes() != (repository / file).read_bytes():
            problems.append(f"{file} differs from that of the repository")
    changelog = get_changelog_from_path(str(folder), package.name)
    # The next version is named "Forthcoming", which catkin_prepare_release replaces.
    if changelog is None or not ("\nForthcoming\n-----------\n* " in changelog.rst or list(changelog.foreach_version())):
        problems.append("CHANGELOG.rst: no version that catkin_pkg reads")
    listed = set(re.findall(r'"(msg/\w+\.msg)"', (folder / "CMakeLists.txt").read_text()))
    present = {f"msg/{file.name}" for file in (folder / "msg").iterdir()}
    problems += [f"{name}: in the folder or in CMakeLists.txt alone" for name in sorted(listed ^ present)]
    print(json.dumps({"name": package.name, "version": package.version, "messages": len(present), "problems": problems}))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
