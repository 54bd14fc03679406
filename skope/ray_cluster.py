"""Connection to a Ray cluster."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from skope.errors import UserError


@contextmanager
def ray_cluster(address: str | None) -> Iterator[Any]:
    """Connect to a Ray cluster; use as a context manager.

    Args:
        address: Address of the cluster. Default: the cluster of this machine, or a new one on it.

    Yields:
        The module `ray`, connected.

    Raises:
        UserError: Ray is not installed, or there is no cluster at `address`.
    """
    try:
        import ray
    except ImportError:
        raise UserError("--engine ray: Ray is not installed; install it with pip install 'skope[ray]'") from None
    started_here = not ray.is_initialized()
    if started_here:
        quiet: dict[str, Any] = {"logging_level": "error", "log_to_driver": False, "include_dashboard": False}
        try:
            ray.init(address=address, **quiet)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UserError(f"--address {address}: no Ray cluster there: {str(error).splitlines()[0]}") from None
    try:
        yield ray
    finally:
        if started_here:
            ray.shutdown()
