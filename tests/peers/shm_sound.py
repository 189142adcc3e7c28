#!/usr/bin/env python3
"""Publishes samples of a microphone over shared memory and receives the squeal that the node finds in them.

Needs `pip install 'iceoryx2==0.10.*'`. Prints one line of JSON; exit code 0 if the end of a squeal was published. The
structures are those of msgs/src/shm.
"""

import ctypes
import json
import sys
import time

import iceoryx2 as iox2
from sound_blocks import BLOCK, RATE_HZ, arguments, blocks, report

CHANNEL_BYTES, UNIT_BYTES, SENSITIVITY_BYTES = 128, 16, 32
ENDED = 1


class Waveform(ctypes.Structure):
    """The user header of a slice of samples."""

    _fields_ = [
        ("stamp_ns", ctypes.c_int64),
        ("sample_rate_hz", ctypes.c_double),
        ("channel_len", ctypes.c_uint8),
        ("unit_len", ctypes.c_uint8),
        ("sensitivity_len", ctypes.c_uint8),
        ("zero", ctypes.c_uint8 * 5),
        ("channel", ctypes.c_uint8 * CHANNEL_BYTES),
        ("unit", ctypes.c_uint8 * UNIT_BYTES),
        ("sensitivity", ctypes.c_uint8 * SENSITIVITY_BYTES),
    ]

    @staticmethod
    def type_name() -> str:
        return "squealcast/Waveform/1"


class Heard(ctypes.Structure):
    _fields_ = [
        ("stamp_ns", ctypes.c_int64),
        ("end_ns", ctypes.c_int64),
        ("prediction_stamp_ns", ctypes.c_int64),
        ("number", ctypes.c_uint64),
        ("harmonic_of", ctypes.c_uint64),
        ("input_seq", ctypes.c_uint64),
        ("frequency_hz", ctypes.c_double),
        ("level_db", ctypes.c_double),
        ("peak_level_db", ctypes.c_double),
        ("prominence_db", ctypes.c_double),
        ("growth_rate_per_s", ctypes.c_double * 3),
        ("predicted_frequency_hz", ctypes.c_double),
        ("predicted_growth_rate_per_s", ctypes.c_double),
        ("harmonic_order", ctypes.c_uint32),
        ("mode_id", ctypes.c_uint32),
        ("state", ctypes.c_uint8),
        ("verdict", ctypes.c_uint8),
        ("quantity", ctypes.c_uint8),
        ("cut", ctypes.c_uint8 * 2),
        ("channel_len", ctypes.c_uint8),
        ("zero", ctypes.c_uint8 * 2),
        ("channel", ctypes.c_uint8 * CHANNEL_BYTES),
    ]

    @staticmethod
    def type_name() -> str:
        return "squealcast/Heard/1"


assert (ctypes.sizeof(Waveform), ctypes.sizeof(Heard)) == (200, 264)


def write_text(header: Waveform, field: str, text: str) -> None:
    encoded = text.encode()
    setattr(header, field + "_len", len(encoded))
    getattr(header, field)[: len(encoded)] = encoded


def main() -> int:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--prefix", default="", help="prefix of the services")
    args = parser.parse_args()
    iox2.set_log_level_from_env_or(iox2.LogLevel.Fatal)
    node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)

    def open_when_there(name: str, build):
        deadline = time.monotonic() + args.patience
        while True:
            try:
                service = iox2.ServiceName.new(args.prefix + name)
                return build(node.service_builder(service)), node.service_builder(service).event().open()
            except Exception as error:  # the wheel has one exception type per service kind
                if time.monotonic() > deadline:
                    sys.exit(f"{name}: {error!r}")
                time.sleep(0.05)

    topic, event = open_when_there(
        "rig/waveform",
        lambda builder: builder.publish_subscribe(iox2.Slice[ctypes.c_float]).user_header(Waveform).open(),
    )
    squeals, _ = open_when_there("squealcast/heard", lambda builder: builder.publish_subscribe(Heard).open())
    publisher = (
        topic.publisher_builder()
        .initial_max_slice_len(BLOCK)
        .allocation_strategy(iox2.AllocationStrategy.PowerOfTwo)
        .create()
    )
    notifier = event.notifier_builder().create()
    subscriber = squeals.subscriber_builder().create()
    heard: list[dict] = []

    def receive() -> None:
        while (sample := subscriber.receive()) is not None:
            one = sample.payload().contents
            heard.append({name: getattr(one, name) for name in ("number", "state", "verdict", "quantity")})
            heard[-1] |= {name: getattr(one, name) for name in ("frequency_hz", "level_db", "end_ns")}
            heard[-1] |= {"channel": bytes(one.channel[: one.channel_len]).decode(), "onset_ns": one.stamp_ns}

    start_ns, sent = time.time_ns(), 0
    begun = time.monotonic()
    for after_s, samples in list(blocks(args.frequency_hz, args.amplitude)):
        block = publisher.loan_slice_uninit(BLOCK)
        header = block.user_header().contents
        header.stamp_ns = start_ns + round(after_s * 1e9)
        header.sample_rate_hz = RATE_HZ
        write_text(header, "channel", "microphone")
        write_text(header, "unit", "Pa")
        write_text(header, "sensitivity", "")
        ctypes.memmove(block.payload().as_ptr(), samples.buffer_info()[0], 4 * BLOCK)
        time.sleep(max(0.0, begun + after_s - time.monotonic()))
        block.assume_init().send()
        notifier.notify()
        sent += 1
        receive()
    deadline = time.monotonic() + args.patience
    while not any(one["state"] == ENDED for one in heard) and time.monotonic() < deadline:
        time.sleep(0.05)
        receive()
    print(json.dumps(report(start_ns, heard, sent)))
    return 0 if any(one["state"] == ENDED for one in heard) else 1


if __name__ == "__main__":
    sys.exit(main())
