"""Loads a launch file and prints, as one line of JSON, the command line that it would start.

    load_launch.py launch/squealcast.launch.py rig:=rig.toml domain:=42

With ROS 2's own `launch` and `launch_ros` where they can be imported: the launch file is then run by them, with a
program in place of the node that notes its command line. There are no wheels of them, so elsewhere by a stand-in of
the few classes that the launch file uses, which `--loader` can also select. The JSON names the loader used.
"""

import argparse
import importlib.util
import json
import os
import stat
import sys
import tempfile
import types
from pathlib import Path


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("arguments", nargs="*", metavar="name:=value")
    parser.add_argument("--loader", choices=("auto", "ros", "stand-in"), default="auto")
    options = parser.parse_args()
    if wrong := [argument for argument in options.arguments if ":=" not in argument]:
        parser.error(f"not name:=value: {', '.join(wrong)}")
    given = dict(argument.split(":=", 1) for argument in options.arguments)

    real = all(importlib.util.find_spec(name) for name in ("launch", "launch_ros"))
    use_ros = options.loader == "ros" or (options.loader == "auto" and real)
    try:
        loaded = load_with_ros(options.file, given) if use_ros else load_with_stand_in(options.file, given)
    except Exception as error:  # noqa: BLE001  any error of the launch file
        print(f"load_launch: {options.file}: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    print(json.dumps({"loader": "ros" if use_ros else "stand-in", **loaded}))
    return 0


def load_with_ros(file: Path, given: dict[str, str]) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ROS_LOG_DIR"] = folder  # read when launch is imported
        from launch import LaunchDescription, LaunchService
        from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
        from launch.launch_description_sources import PythonLaunchDescriptionSource

        source = PythonLaunchDescriptionSource(str(file))
        noted = Path(folder, "argv")
        program = Path(folder, "program")
        program.write_text(
            f"#!{sys.executable}\nimport json, sys\nopen({str(noted)!r}, 'w').write(json.dumps(sys.argv[1:]))\n"
        )
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
        service = LaunchService(argv=[])
        include = IncludeLaunchDescription(source, launch_arguments={**given, "executable": str(program)}.items())
        service.include_launch_description(LaunchDescription([include]))
        # stdout is for the JSON alone.
        stdout = os.dup(1)
        os.dup2(2, 1)
        code = service.run()
        os.dup2(stdout, 1)
        if code or not noted.exists():
            raise RuntimeError(f"launch ended with {code} and {'a' if noted.exists() else 'no'} process started")
        description = source.try_get_launch_description_without_context()
        declared = [e for e in description.entities if isinstance(e, DeclareLaunchArgument)]
        defaults = {a.name: "".join(part.text for part in a.default_value) for a in declared}
        executable = given.get("executable", defaults["executable"])
        return {"command": [executable, *json.loads(noted.read_text())], "arguments": defaults}


def load_with_stand_in(file: Path, given: dict[str, str]) -> dict[str, object]:
    """The behaviour of launch and launch_ros for the few classes used here, after their sources (jazzy)."""

    class LaunchDescription:
        def __init__(self, entities):
            self.entities = entities

    class DeclareLaunchArgument:
        def __init__(self, name, *, default_value, description):
            self.name, self.default_value, self.description = name, default_value, description

    class OpaqueFunction:
        def __init__(self, *, function):
            self.function = function

    class LaunchConfiguration:
        def __init__(self, name):
            self.name = name

        def perform(self, context):
            return context[self.name]

    class Node:
        def __init__(self, *, executable, namespace, arguments, parameters, output):
            parts = [executable, *arguments, "--ros-args"]
            for path in parameters:
                parts += ["--params-file", path]
            if namespace is not None:
                parts += ["-r", "__ns:=/" + namespace.strip("/")]
            if not all(isinstance(part, str) for part in parts):
                raise TypeError(f"not all text: {parts}")
            self.command = parts

    modules = {
        "launch": {"LaunchDescription": LaunchDescription},
        "launch.actions": {"DeclareLaunchArgument": DeclareLaunchArgument, "OpaqueFunction": OpaqueFunction},
        "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node},
    }
    for name, content in modules.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(content)

    spec = importlib.util.spec_from_file_location("launch_file", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    description = module.generate_launch_description()

    context: dict[str, str] = dict(given)
    defaults: dict[str, str] = {}
    commands = []
    for entity in description.entities:
        if isinstance(entity, DeclareLaunchArgument):
            defaults[entity.name] = entity.default_value
            context.setdefault(entity.name, entity.default_value)
        else:
            commands += [node.command for node in entity.function(context)]
    if unknown := sorted(set(given) - set(defaults)):
        raise ValueError(f"no such launch argument: {', '.join(unknown)}")
    if len(commands) != 1:
        raise ValueError(f"{len(commands)} nodes instead of 1")
    return {"command": commands[0], "arguments": defaults}


if __name__ == "__main__":
    sys.exit(main())
