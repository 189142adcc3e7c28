"""The samples that the sound peers publish: a tone with flanks of 10 ms in a quiet channel, in blocks of 1024 at 48 kHz."""

import argparse
import array
import math

RATE_HZ = 48_000
BLOCK = 1024
ONSET_S, END_S, LENGTH_S = 1.0, 2.0, 3.0


def arguments(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--frequency-hz", type=float, default=2345.6)
    parser.add_argument("--amplitude", type=float, default=0.5, help="in Pa")
    parser.add_argument("--patience", type=float, default=30.0, help="seconds to wait for the node, and for the squeal")
    return parser


def blocks(frequency_hz: float, amplitude: float):
    """The time of the first sample of each block after the start, and its samples, which are rounded to float32."""
    for first in range(0, int(LENGTH_S * RATE_HZ), BLOCK):
        samples = array.array("f", bytes(4 * BLOCK))
        for k in range(BLOCK):
            t = (first + k) / RATE_HZ
            flank = min(max(min(t - ONSET_S, END_S - t) / 0.01, 0.0), 1.0)
            samples[k] = amplitude * math.sin(0.5 * math.pi * flank) ** 2 * math.sin(2 * math.pi * frequency_hz * t)
        yield first / RATE_HZ, samples


def report(start_ns: int, heard: list[dict], sent: int) -> dict:
    """What the peer prints."""
    return {
        "blocks": sent,
        "samples": sent * BLOCK,
        "start_ns": start_ns,
        "heard": heard,
    }
