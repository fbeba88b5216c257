"""NumPy's matrix products on one thread, for code that has threads of its own or narrow matrices.

Where each of several threads calls a product that starts threads again, or products are small, these wait for each
other actively; on two busy cores that took ten times the time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Keep the linear algebra of NumPy and SciPy on the calling thread; a context, or a decorator when called."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield
