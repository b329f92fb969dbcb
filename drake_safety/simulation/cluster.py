"""A cluster of workers: dask's scheduler as joblib's backend."""

import contextlib
from collections.abc import Iterator

from drake_safety.extras import require_extra


@contextlib.contextmanager
def connected(address: str, *, timeout_s: float = 20.0) -> Iterator[None]:
    """Simulates on a dask cluster, in place of processes of this machine, while the block runs."""
    require_extra("cluster", f"cluster '{address}'")
    import joblib
    from distributed import Client

    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(Client(address, timeout=timeout_s))
            client.wait_for_workers(1, timeout=timeout_s)
        # Another server's answer may be taken for the size of a huge message.
        except (MemoryError, OSError, TimeoutError, ValueError) as error:
            raise ValueError(f"no dask workers answer at '{address}': {error}") from error
        stack.enter_context(joblib.parallel_config("dask", client=client, n_jobs=-1))
        yield
