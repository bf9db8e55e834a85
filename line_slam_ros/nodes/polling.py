"""Takes what comes in past the executor, in a thread of its own: fast topics in batches, requests that take long."""
from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.service import Service
from rclpy.subscription import Subscription

InvalidHandle = rclpy_implementation.InvalidHandle
MESSAGES_EVERY_S, REQUESTS_EVERY_S = 0.005, 0.05


class Polled(CallbackGroup):
    """Keeps its subscriptions and services out of every executor.

    rclpy's executor wakes for every message and then builds its wait set anew, which costs half a millisecond with the
    interpreter locked: at 200 Hz a tenth of a core, and as much again for the computing thread that has to wait.
    """

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


class Poller:
    """A thread that serves what waits, every so often."""

    def __init__(self, serve: Callable[[], None], period_s: float) -> None:
        self._serve, self._period_s = serve, period_s
        self._ended, self._over = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name='poller', daemon=True)
        self._thread.start()

    @classmethod
    def of_messages(cls, subscription: Subscription) -> Poller:
        """Hands the messages of a subscription to its callback."""
        def serve() -> None:
            handle = subscription.handle
            with handle:
                while (taken := handle.take_message(subscription.msg_type, subscription.raw)) is not None:
                    subscription.callback(taken[0])
        return cls(serve, MESSAGES_EVERY_S)

    @classmethod
    def of_requests(cls, service: Service) -> Poller:
        """Answers the requests of a service by its callback."""
        def serve() -> None:
            with service.handle:
                request, header = service.handle.service_take_request(service.srv_type.Request)
            if header is not None:
                service.send_response(service.callback(request, service.srv_type.Response()), header)
        return cls(serve, REQUESTS_EVERY_S)

    def stop(self) -> None:
        """Ends the thread; a subscription or service that is destroyed first ends it, too."""
        self._ended.set()
        self._thread.join(timeout=5.0)  # it may be saving a large map; the thread is a daemon

    @property
    def died(self) -> bool:
        """Whether an exception ended the thread."""
        return not self._over and not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._ended.wait(self._period_s):
                self._serve()
        except InvalidHandle:
            pass
        self._over = True
