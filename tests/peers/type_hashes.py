"""Prints the hashes (REP-2016) that rosbags computes of message types, as JSON.

Usage: type_hashes.py FILE, a JSON object of type names and their `ros2msg` schemas
"""

import json
import sys

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

with open(sys.argv[1]) as file:
    schemas = json.load(file)
store = get_typestore(Stores.EMPTY)
for name, text in schemas.items():
    store.register(get_types_from_msg(text, name))
json.dump({name: store.hash_rihs01(name) for name in schemas}, sys.stdout)
