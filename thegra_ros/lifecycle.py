"""Base of the nodes: a lifecycle node that starts itself, refuses invalid requests instead of dying of them, and says why a transition failed."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from thegra_core.errors import ThegraError
from thegra_ros.answers import answering
from thegra_ros.environment import end_with_supervisor
from thegra_ros.qos import publisher_options, subscription_options

WATCH = "end in time"
WATCH_S = 0.1
WAKE_S = 0.5
"""A shutdown wakes the executor, but not always; it looks by itself so often."""
LAST_WORDS_S = 2.3
"""How long a node that is told to end may take to release what it holds."""
MOST_INTERRUPTS = 2
"""So many are one: impatience, or a terminal and a supervisor."""
FINALIZATION_S = 10.0
"""How long Python's own end may take, in which SIGINT is ignored."""


class ManagedNode(LifecycleNode):
    """Derived nodes override `configure`, `activate`, `deactivate` and `release`.

    A ThegraError they raise is logged as one message and the transition fails; anything else is logged with its traceback. Publishers, subscriptions and
    timers made through `publisher`, `listen` and `every` are removed when the node is cleaned up; services made through `offer` answer in every state.
    """

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.configured = self.active = False
        self._mine: list[tuple[Callable[[Any], Any], Any]] = []
        self._waiting_services = ReentrantCallbackGroup()  # one that waits for its answer holds nothing up
        self._guard_transitions()
        self._autostart = bool(self.declare_parameter("autostart", True, ParameterDescriptor(description="configure and activate the node when it starts")).value)

    def configure(self) -> None:
        """Read the parameters and make what is needed."""

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """Stop working; what is known is kept."""

    def release(self) -> None:
        """Undo `configure`, also a half-done one."""

    def start(self) -> bool:
        """Configure and activate if the parameter `autostart` says so; False: it was tried and failed."""
        if not self._autostart:
            return True
        done = TransitionCallbackReturn.SUCCESS
        return self.trigger_configure() == done and self.trigger_activate() == done

    # ---- entities -------------------------------------------------------------------------------------------------------------------

    def publisher(self, kind: type, topic: str, qos: Any, always: bool = False) -> Any:
        """A publisher that is silent unless the node is active, or `always` speaks."""
        make, destroy = (self.create_publisher, self.destroy_publisher) if always else (self.create_lifecycle_publisher, self.destroy_lifecycle_publisher)
        made = make(kind, topic, qos, **publisher_options(self, topic))
        self._mine.append((destroy, made))
        return made

    def listen(self, kind: type, topic: str, qos: Any, callback: Callable[[Any], None]) -> Any:
        """A subscription."""
        made = self.create_subscription(kind, topic, callback, qos, **subscription_options(self, topic))
        self._mine.append((self.destroy_subscription, made))
        return made

    def offer(self, kind: type, name: str, handle: Callable[[Any], str | Awaitable[str]]) -> None:
        """A service (Trigger or SetBool) for as long as the node lives; `handle` gets the request and returns what to say.

        A ThegraError, or a call while the node is not configured, is the answer `success: false` with its message; nothing else is raised into the node.
        """
        self.create_service(kind, name, answering(self, name, handle), callback_group=self._waiting_services)

    def every(self, period_s: float, callback: Callable[[], None]) -> None:
        """A timer of the machine's time, whatever simulated time does."""
        clock = rclpy.clock.Clock(clock_type=rclpy.clock.ClockType.STEADY_TIME)
        self._mine.append((self.destroy_timer, self.create_timer(period_s, callback, clock=clock)))

    # ---- transitions ----------------------------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._try(self.configure, lambda: super(ManagedNode, self).on_configure(state))
        self.configured = result == TransitionCallbackReturn.SUCCESS
        if result != TransitionCallbackReturn.SUCCESS:
            self._undo()
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._try(lambda: super(ManagedNode, self).on_activate(state), self.activate)
        self.active = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        return self._try(self.deactivate, lambda: super(ManagedNode, self).on_deactivate(state))

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._try(self._undo)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        return self._try(self._undo)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        return self._try(self._undo)

    def end(self) -> None:
        """Release everything when the process ends, whatever state the node is in."""
        self.active = False
        self._try(self._undo)

    def _undo(self) -> None:
        self.configured = False
        self.release()
        for destroy, entity in reversed(self._mine):
            destroy(entity)
        self._mine.clear()

    def _try(self, *steps: Callable[[], Any]) -> TransitionCallbackReturn:
        # rclpy takes any exception in a transition for an error and says nothing of it
        try:
            results = [step() for step in steps]
        except ThegraError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception:
            self.get_logger().error(f"transition failed:\n{traceback.format_exc()}")
            return TransitionCallbackReturn.ERROR
        return next((r for r in results if isinstance(r, TransitionCallbackReturn) and r != TransitionCallbackReturn.SUCCESS), TransitionCallbackReturn.SUCCESS)

    def _guard_transitions(self) -> None:
        # a request that is invalid in the present state raises out of spin() and would end the node
        for service in self.services:
            if service.srv_name.endswith("/change_state"):
                service.callback = self._guarded(service.callback)

    def _guarded(self, change_state: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        def guard(request: Any, response: Any) -> Any:
            try:
                return change_state(request, response)
            except Exception as error:  # RCLError is no public class
                self.get_logger().warning(f"transition {request.transition.label or request.transition.id} refused: {error}")
                response.success = False
                return response

        return guard


class _Interrupt:
    """SIGINT ends a node by an exception, once: raised again it would break off the end. More than `MOST_INTERRUPTS` end the process where it is."""

    def __init__(self) -> None:
        self.ending = False
        self._count = 0

    def __call__(self, *_: object) -> None:
        self._count += 1
        if self._count > MOST_INTERRUPTS:
            _end(1)
        if self._count == 1 and not self.ending:
            raise KeyboardInterrupt


@dataclass
class _Outcome:
    """What the process is to end with, for whoever ends it."""

    code: int = 0


def run_node(make: Callable[[], ManagedNode], arguments: Sequence[str] | None = None) -> int:
    """Run a node until it is told to end (SIGINT, SIGTERM); the exit code: 0, 2 if it could not start, 1 if it failed. The process has to end with it.

    Where it has not ended `LAST_WORDS_S` after its context was shut down it is ended with that code: neither a transport that waits for a partner that was
    killed nor a thread that still computes keeps a node alive.
    """
    end_with_supervisor()
    interrupt = _Interrupt()
    signal.signal(signal.SIGINT, interrupt)  # before rclpy.init: its handler shuts the context down, and calls this one
    try:
        rclpy.init(args=arguments)
    except Exception as error:  # RCLError is no public class
        sys.stderr.write(f"thegra: ROS arguments not understood: {error}\n")
        return 2
    outcome = _Outcome()
    threading.Thread(target=_end_in_time, args=(outcome,), daemon=True, name=WATCH).start()
    node: ManagedNode | None = None
    executor = SingleThreadedExecutor()
    try:
        node = make()
        executor.add_node(node)
        if node.start():
            while rclpy.ok():
                executor.spin_once(timeout_sec=WAKE_S)
        elif rclpy.ok():
            outcome.code = 2
    except ThegraError as error:
        rclpy.logging.get_logger("thegra").error(str(error))
        outcome.code = 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        if rclpy.ok():  # else it was told to end while it was still being made
            traceback.print_exc()
            outcome.code = 1
    finally:
        interrupt.ending = True
        if node is not None:
            node.end()
            executor.remove_node(node)
            node.destroy_node()
        rclpy.try_shutdown()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Python's own end puts the default back: one that comes then would become the exit code
        signal.setitimer(signal.ITIMER_REAL, FINALIZATION_S)  # the kernel ends what hangs there
        if any(thread.daemon and thread.name != WATCH for thread in threading.enumerate()):
            _end(outcome.code)
    return outcome.code


def _end_in_time(outcome: _Outcome) -> None:
    """Watch the context: once it is shut down, by a signal or by `run_node` itself, what holds the process up may do so no longer."""
    while rclpy.ok():
        time.sleep(WATCH_S)
    time.sleep(LAST_WORDS_S)
    _end(outcome.code)


def _end(code: int) -> None:
    """End without Python's own end: a thread that comes back from a network or a solver to an interpreter that is gone takes the process down with it."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
