#!/usr/bin/env python3
"""A rig in another language: publishes operating points over shared memory and checks the predictions.

Needs `pip install 'iceoryx2==0.10.*'`. Prints one line of JSON; exit code 0 if every operating point was answered with
its stamp and sequence number, 1 if not. The structures are those of msgs/src/shm.
"""

import argparse
import ctypes
import json
import math
import sys
import time

import iceoryx2 as iox2

MAX_MODES = 64
REASON_BYTES = 128


class OperatingPoint(ctypes.Structure):
    _fields_ = [
        ("stamp_ns", ctypes.c_int64),
        ("seq", ctypes.c_uint64),
        ("normal_load_n", ctypes.c_double),
        ("disc_speed_rad_s", ctypes.c_double),
        ("friction_coefficient", ctypes.c_double),
    ]

    @staticmethod
    def type_name() -> str:
        return "squealcast/OperatingPoint/1"


class Mode(ctypes.Structure):
    _fields_ = [
        ("id", ctypes.c_uint32),
        ("zero", ctypes.c_uint32),
        ("frequency_hz", ctypes.c_double),
        ("growth_rate_per_s", ctypes.c_double),
        ("damping_ratio", ctypes.c_double),
        ("pad_participation", ctypes.c_double),
        ("residual", ctypes.c_double),
        ("frequency_error_hz", ctypes.c_double),
        ("growth_rate_error_per_s", ctypes.c_double),
    ]


class Prediction(ctypes.Structure):
    _fields_ = [
        ("stamp_ns", ctypes.c_int64),
        ("input_seq", ctypes.c_uint64),
        ("max_growth_rate_per_s", ctypes.c_double),
        ("worst_frequency_hz", ctypes.c_double),
        ("critical_friction", ctypes.c_double),
        ("friction_margin", ctypes.c_double),
        ("friction_margin_error", ctypes.c_double),
        ("unstable_modes", ctypes.c_uint32),
        ("mode_count", ctypes.c_uint32),
        ("level", ctypes.c_uint8),
        ("reused", ctypes.c_uint8),
        ("reason_len", ctypes.c_uint8),
        ("zero", ctypes.c_uint8 * 5),
        ("reason", ctypes.c_uint8 * REASON_BYTES),
        ("modes", Mode * MAX_MODES),
    ]

    @staticmethod
    def type_name() -> str:
        return "squealcast/Prediction/2"


assert (ctypes.sizeof(OperatingPoint), ctypes.sizeof(Mode), ctypes.sizeof(Prediction)) == (40, 64, 4296)


def open_services(node, name, payload, rig):
    """The topic and its event service, with any settings they have; created with room for many otherwise."""
    service = iox2.ServiceName.new(name)
    topic = (
        node.service_builder(service)
        .publish_subscribe(payload)
        .max_publishers(8)
        .max_subscribers(32)
        .max_nodes(64)
        .history_size(16)
        .subscriber_max_buffer_size(64)
        .open_or_create()
        if rig.create
        else node.service_builder(service).publish_subscribe(payload).open()
    )
    event = node.service_builder(service).event()
    return topic, event.open_or_create() if rig.create else event.open()


def connect(node, rig):
    """Both services, once the other side has created them."""
    deadline = time.monotonic() + rig.patience
    while True:
        try:
            return (
                open_services(node, rig.prefix + "rig/operating_point", OperatingPoint, rig),
                open_services(node, rig.prefix + "squealcast/prediction", Prediction, rig),
            )
        except Exception as error:  # the wheel has one exception type per service kind
            if time.monotonic() > deadline:
                sys.exit(f"no services: {error!r}")
            time.sleep(0.05)


def faults_of(prediction, sent):
    """What is wrong with a prediction, given when each sequence number was stamped."""
    faults = []
    if sent.get(prediction.input_seq) != prediction.stamp_ns:
        faults.append(f"seq {prediction.input_seq}: stamp {prediction.stamp_ns}, sent {sent.get(prediction.input_seq)}")
    if prediction.level > 3 or prediction.reused > 1 or any(prediction.zero):
        faults.append(f"seq {prediction.input_seq}: level {prediction.level}, reused {prediction.reused}")
    if prediction.mode_count > MAX_MODES or prediction.reason_len > REASON_BYTES:
        return faults + [f"seq {prediction.input_seq}: {prediction.mode_count} modes"]
    try:
        bytes(prediction.reason[: prediction.reason_len]).decode()
    except UnicodeDecodeError as error:
        faults.append(f"seq {prediction.input_seq}: reason {error}")
    frequencies = [mode.frequency_hz for mode in prediction.modes[: prediction.mode_count]]
    if not all(map(math.isfinite, frequencies)) or frequencies != sorted(frequencies):
        faults.append(f"seq {prediction.input_seq}: frequencies {frequencies}")
    return faults


def is_silence_fault(prediction):
    return prediction.level == 3 and b"stale" in bytes(prediction.reason[: prediction.reason_len])


def percentile(values, share):
    return sorted(values)[min(len(values) - 1, int(share * len(values)))] if values else None


def run(rig):
    iox2.set_log_level(iox2.LogLevel.Error)
    node = (
        iox2.NodeBuilder.new()
        .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        .create(iox2.ServiceType.Ipc)
    )
    (points, points_event), (predictions, predictions_event) = connect(node, rig)
    subscriber = predictions.subscriber_builder().create()
    listener = predictions_event.listener_builder().create()
    publisher = points.publisher_builder().create()
    notifier = points_event.notifier_builder().create()

    sent, answered, latencies_us, faults, foreign = {}, set(), [], [], 0
    ahead = rig.first_seq

    def receive(until):
        nonlocal foreign
        while True:
            sample = subscriber.receive()
            while sample is not None:
                prediction = Prediction.from_buffer_copy(sample.payload().contents)
                sample.delete()
                if is_silence_fault(prediction):
                    pass  # the node's own report that inputs stopped coming: it answers nothing
                elif prediction.input_seq not in sent:
                    foreign += 1
                else:
                    latencies_us.append((time.time_ns() - prediction.stamp_ns) / 1e3)
                    if prediction.input_seq in answered:
                        faults.append(f"seq {prediction.input_seq}: answered twice")
                    answered.add(prediction.input_seq)
                    faults.extend(faults_of(prediction, sent))
                sample = subscriber.receive()
            left = until - time.monotonic()
            if left <= 0 or (len(sent) == rig.count and len(answered) == rig.count):
                return
            listener.timed_wait(iox2.Duration.from_secs_f64(min(left, 0.05)))

    period = 1.0 / rig.rate
    start = time.monotonic()
    last = start - period
    for index in range(rig.count):
        # After a stall it catches up at no more than twice the rate: a burst would test the queue, not the node.
        due = max(start + index * period, last + period / 2)
        receive(due)
        last = time.monotonic()
        seq = ahead + index
        friction = 0.3 + 0.1 * (index % 100) / 100
        stamp_ns = time.time_ns()
        sent[seq] = stamp_ns
        point = OperatingPoint(stamp_ns, seq, rig.load, rig.speed, friction)
        publisher.send_copy(point)
        notifier.notify()
    receive(time.monotonic() + rig.patience)

    report = {
        "sent": len(sent),
        "answered": len(answered),
        "foreign": foreign,
        "faults": faults[:10],
        "fault_count": len(faults),
        "seconds": round(time.monotonic() - start, 3),
        "latency_us": {f"p{int(100 * share)}": percentile(latencies_us, share) for share in (0.5, 0.9, 0.99)}
        | {"max": max(latencies_us, default=None)},
    }
    print(json.dumps(report), flush=True)
    return 0 if len(answered) == rig.count and not faults else 1


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000, help="operating points to publish")
    parser.add_argument("--rate", type=float, default=500.0, help="operating points per second")
    parser.add_argument("--prefix", default="", help="before every service name")
    parser.add_argument("--first-seq", type=int, default=0)
    parser.add_argument("--load", type=float, default=500.0, help="N")
    parser.add_argument("--speed", type=float, default=13.0, help="rad/s")
    parser.add_argument("--patience", type=float, default=5.0, help="seconds to wait for services and last answers")
    parser.add_argument("--create", action="store_true", help="create the services where there are none")
    sys.exit(run(parser.parse_args()))


if __name__ == "__main__":
    main()
