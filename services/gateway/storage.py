"""Work on the shared storage, in threads of its own: where it hangs, robots are still heard."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
_THREADS = ThreadPoolExecutor(8, thread_name_prefix="storage")


async def on_storage(act: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
    """Do what reads or writes the shared storage."""
    loop = asyncio.get_running_loop()
    return await loop.run_in_executor(_THREADS, partial(act, *args, **options))
