"""Asks a node for the descriptions of the types of its topics, and prints one line of JSON: for every type the hash that
the node gave it, or why it refused.

Usage: rclpy_types.py --domain N [--node NAME] FILE, a JSON object of type names and hashes
"""

import argparse
import json
import os
import sys

arguments = argparse.ArgumentParser()
arguments.add_argument("--domain", required=True)
arguments.add_argument("--node", default="/squealcast")
arguments.add_argument("types")
arguments = arguments.parse_args()
os.environ["ROS_DOMAIN_ID"] = arguments.domain
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import rclpy  # noqa: E402
from type_description_interfaces.srv import GetTypeDescription  # noqa: E402


def described(message):
    """A type description as its JSON file has it."""
    kind = lambda t: {n: getattr(t, n) for n in ("type_id", "capacity", "string_capacity", "nested_type_name")}  # noqa: E731
    fields = lambda d: [{"name": f.name, "type": kind(f.type), "default_value": f.default_value} for f in d.fields]  # noqa: E731
    one = lambda d: {"type_name": d.type_name, "fields": fields(d)}  # noqa: E731
    return {
        "type_description": one(message.type_description),
        "referenced_type_descriptions": [one(d) for d in message.referenced_type_descriptions],
    }


with open(arguments.types) as file:
    wanted = json.load(file)
rclpy.init()
node = rclpy.create_node("asks_for_types")
client = node.create_client(GetTypeDescription, f"{arguments.node}/get_type_description")
found = {}
if client.wait_for_service(timeout_sec=15.0):
    for name, digest in wanted.items():
        request = GetTypeDescription.Request(type_name=name, type_hash=digest, include_type_sources=True)
        for _ in range(3):  # a request that is sent before the node has found this client may be lost
            answer = client.call_async(request)
            rclpy.spin_until_future_complete(node, answer, timeout_sec=5.0)
            if answer.done():
                break
        if not answer.done():
            found[name] = {"error": "no answer"}
            continue
        answer = answer.result()
        found[name] = {
            "error": "" if answer.successful else answer.failure_reason,
            "description": described(answer.type_description),
            "sources": {source.type_name: source.encoding for source in answer.type_sources},
        }
print(json.dumps(found))
sys.stdout.flush()
os._exit(0)
