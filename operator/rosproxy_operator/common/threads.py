"""Blocking calls in daemon threads, which do not delay the end of the process."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


async def in_thread(function: Callable[..., T], *arguments: object) -> T:
    """Call ``function`` in a new daemon thread. Return the result, or raise the exception.

    The threads of asyncio's executor would delay the end of the process, and a call that hangs
    would occupy a thread of the executor.
    """
    done: Future[T] = Future()
    done.set_running_or_notify_cancel()  # a caller that stops waiting can't cancel the call

    def work() -> None:
        try:
            done.set_result(function(*arguments))
        except BaseException as error:  # the caller of `in_thread` gets the exception
            done.set_exception(error)

    threading.Thread(target=work, daemon=True, name=getattr(function, "__name__", "call")).start()
    return await asyncio.wrap_future(done)
