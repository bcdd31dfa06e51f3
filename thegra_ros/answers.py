"""Services that answer in every state of a node, and wait for their answer without holding the node up."""

from __future__ import annotations

import concurrent.futures
import inspect
import traceback
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from rclpy.task import Future

from thegra_core.errors import ThegraError

if TYPE_CHECKING:
    from thegra_ros.lifecycle import ManagedNode


def answering(node: ManagedNode, name: str, handle: Callable[[Any], str | Awaitable[str]]) -> Callable[[Any, Any], Awaitable[Any]]:
    """A callback for a service whose response has `success` and `message`: what `handle` returns is the message, what it raises the failure."""

    async def answer(request: Any, response: Any) -> Any:
        try:
            response.message = await _said(node, handle, request)
            response.success = True
            node.get_logger().info(f"{name}: {response.message}")
        except ThegraError as error:
            response.success, response.message = False, str(error)
            node.get_logger().warning(f"{name} refused: {error}")
        except Exception as error:  # raised into the executor it would end the node
            response.success, response.message = False, str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
            node.get_logger().error(f"{name} failed:\n{traceback.format_exc()}")
        return response

    return answer


async def _said(node: ManagedNode, handle: Callable[[Any], str | Awaitable[str]], request: Any) -> str:
    if not node.configured:
        raise ThegraError("the node is not configured: configure it first")
    said = handle(request)
    return await said if inspect.isawaitable(said) else said


async def result_of(node: ManagedNode, work: concurrent.futures.Future[str]) -> str:
    """Wait in a callback of the node for what another thread finds.

    Raises:
        Exception: What the work raised.
    """
    done = Future()

    def tell(_: object) -> None:
        done.set_result(None)
        if node.executor is not None:
            node.executor.wake()

    work.add_done_callback(tell)
    await done
    return work.result()
