"""Starts the node.

ros2 launch launch/squealcast.launch.py rig:=tribometer record:=recordings
ros2 launch launch/squealcast.launch.py --show-args
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

HERE = Path(__file__).resolve().parent

ARGUMENTS = [
    DeclareLaunchArgument("rig", default_value="tribometer", description="rig file, or name of an embedded rig"),
    DeclareLaunchArgument("namespace", default_value="", description="namespace of the node and its topics; empty: /"),
    DeclareLaunchArgument("domain", default_value="", description="DDS domain; empty: ROS_DOMAIN_ID, or 0"),
    DeclareLaunchArgument("loopback", default_value="false", description="true: speak to this machine alone"),
    DeclareLaunchArgument("record", default_value="", description="folder to record into; empty: no recording"),
    DeclareLaunchArgument("managed", default_value="false", description="true: start unconfigured, as a managed node"),
    DeclareLaunchArgument("params_file", default_value=str(HERE / "params.yaml"), description="the node's parameters"),
    DeclareLaunchArgument("executable", default_value="squealcast", description="the program, or its path"),
]


def start_node(context):
    given = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in ARGUMENTS}
    if not Path(given["params_file"]).is_file():
        raise RuntimeError(f"params_file:={given['params_file']}: no such file")  # launch would start the node without
    for name in ("loopback", "managed"):
        if given[name].lower() not in ("true", "false"):
            raise RuntimeError(f"{name}:={given[name]}: neither true nor false")

    arguments = ["run", given["rig"]]
    if given["domain"]:
        arguments += ["--domain", given["domain"]]
    if given["loopback"].lower() == "true":
        arguments += ["--loopback"]
    if given["managed"].lower() == "true":
        arguments += ["--managed"]
    if given["record"]:
        arguments += ["--record", given["record"]]
    return [
        Node(
            executable=given["executable"],
            namespace=given["namespace"] or None,
            arguments=arguments,
            parameters=[given["params_file"]],
            output="screen",
        )
    ]


def generate_launch_description():
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=start_node)])
