"""The exchange of rclpy_peer.py by a second DDS implementation: CycloneDDS, without anything of ROS.

Run it with the `python` that setup.sh installs. Prints one line of JSON; exit code 0 only if every check passes.
"""

import os
import sys
import threading
from dataclasses import dataclass

from exchange import DEPTH, Answer, Exchange, arguments, bound_run_time, run_time_limit

# Loopback only, found by unicast.
os.environ["CYCLONEDDS_URI"] = """<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
    <AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>"""

# Only now: CycloneDDS reads the variable when it is loaded.
from cyclonedds.core import Policy, Qos  # noqa: E402
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.idl import IdlStruct  # noqa: E402
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32, uint64  # noqa: E402
from cyclonedds.pub import DataWriter  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402
from cyclonedds.util import duration  # noqa: E402


# The messages of msgs/ as ROS 2 names them on DDS.
@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class OperatingPoint(IdlStruct, typename="squealcast_msgs::msg::dds_::OperatingPoint_"):
    header: Header
    seq: uint64
    normal_load_n: float64
    disc_speed_rad_s: float64
    friction_coefficient: float64


@dataclass
class Mode(IdlStruct, typename="squealcast_msgs::msg::dds_::Mode_"):
    id: uint32
    frequency_hz: float64
    growth_rate_per_s: float64
    damping_ratio: float64
    pad_participation: float64
    residual: float64
    frequency_error_hz: float64
    growth_rate_error_per_s: float64


@dataclass
class Prediction(IdlStruct, typename="squealcast_msgs::msg::dds_::Prediction_"):
    header: Header
    input_seq: uint64
    level: uint8
    reused: bool
    unstable_modes: uint32
    max_growth_rate_per_s: float64
    worst_frequency_hz: float64
    critical_friction: float64
    friction_margin: float64
    friction_margin_error: float64
    reason: str
    modes: sequence[Mode]


def main() -> int:
    args = arguments(__doc__.splitlines()[0]).parse_args()
    bound_run_time(run_time_limit(args))
    exchange = Exchange(args)

    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.Durability.Volatile,
        Policy.History.KeepLast(DEPTH),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    participant = DomainParticipant(args.domain)
    writer = DataWriter(participant, Topic(participant, "rt/rig/operating_point", OperatingPoint), qos=qos)
    reader = DataReader(participant, Topic(participant, "rt/squealcast/prediction", Prediction), qos=qos)

    stop = threading.Event()

    def read() -> None:
        while not stop.is_set():
            for message in reader.take_iter(timeout=duration(milliseconds=100)):
                exchange.answer(Answer.of(message))

    thread = threading.Thread(target=read)
    thread.start()
    try:
        inputs, answers = writer.get_matched_subscriptions, reader.get_matched_publications
        if not exchange.discover(
            lambda: bool(inputs() and answers()),
            lambda: (
                f"{len(inputs())} readers of rt/rig/operating_point, "
                f"{len(answers())} writers of rt/squealcast/prediction"
            ),
        ):
            return exchange.finish("cyclonedds", {})
        for seq, stamp_ns, mu in exchange.points():
            header = Header(Time(*divmod(stamp_ns, 1_000_000_000)), "rig")
            writer.write(OperatingPoint(header, seq, args.load, args.speed, mu))
        exchange.drain()
        return exchange.finish("cyclonedds", {})
    finally:
        stop.set()
        thread.join()


if __name__ == "__main__":
    sys.exit(main())
