"""A Zenoh router on this machine alone, as `rmw_zenohd` is one. Prints its port, and runs until standard input is closed.

Usage: zenoh_router.py PORT
"""

import sys

import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print(sys.argv[1], flush=True)
    sys.stdin.read()
