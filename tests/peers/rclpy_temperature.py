"""Publishes the temperature of the contact over ROS 2 with rclpy, as a thermocouple's driver would.

Repeats one `sensor_msgs/Temperature` until the node says in a session event that its rig has this temperature. Prints one
line of JSON; exit code 0 if it did. Run it with the `ros-python` that setup.sh installs.
"""

import argparse
import json
import os
import sys
import time

from spinning import spinning

# `SessionEvent.TEMPERATURE`: the wire's number, so that messages built before it had a name will do.
TEMPERATURE = 5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--celsius", type=float, required=True)
    parser.add_argument("--patience", type=float, default=30.0, help="seconds")
    args = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(args.domain)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Temperature
    from squealcast_msgs.msg import SessionEvent

    followed: list[float] = []

    def on_event(event) -> None:
        if event.kind == TEMPERATURE:
            followed.append(event.value)

    sent = 0
    with spinning("squealcast_test_thermocouple") as node:
        publisher = node.create_publisher(Temperature, "/rig/temperature", qos_profile_sensor_data)
        node.create_subscription(SessionEvent, "/squealcast/session_event", on_event, 100)
        message = Temperature(temperature=args.celsius, variance=0.25)
        message.header.frame_id = "pad"
        deadline = time.monotonic() + args.patience
        while not followed and time.monotonic() < deadline:
            message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)
            sent += 1
            time.sleep(0.05)
    print(json.dumps({"sent": sent, "followed": followed}))
    return 0 if followed == [args.celsius] else 1


if __name__ == "__main__":
    sys.exit(main())
