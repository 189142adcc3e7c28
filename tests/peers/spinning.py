"""A node of rclpy whose callbacks run on a thread of their own."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def spinning(name: str) -> Iterator:
    """The node `name`, until the end of the block. rclpy reads its environment here."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    rclpy.init(args=[])
    node = rclpy.create_node(name)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stop = threading.Event()

    def spin() -> None:
        try:
            while not stop.is_set():
                executor.spin_once(timeout_sec=0.1)
        except ExternalShutdownException:
            pass

    spinner = threading.Thread(target=spin)
    spinner.start()
    try:
        yield node
    finally:
        stop.set()
        spinner.join()
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
