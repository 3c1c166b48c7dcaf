"""Blocking calls beside the event loop, in threads that never keep the process from ending."""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


async def in_thread(function: Callable[..., T], *arguments: object) -> T:
    """What ``function`` returns or raises, called in a daemon thread of its own.

    Unlike the threads of asyncio's executor it is not waited for at the end of the process, and a
    call that hangs takes no place from another one.
    """
    done: Future[T] = Future()
    done.set_running_or_notify_cancel()  # who waits may give up; the call itself goes on

    def work() -> None:
        try:
            done.set_result(function(*arguments))
        except BaseException as error:  # raised again where it is awaited
            done.set_exception(error)

    threading.Thread(target=work, daemon=True, name=getattr(function, "__name__", "call")).start()
    return await asyncio.wrap_future(done)
