"""The random draws of an episode as a point of a space of standard normal numbers."""

from typing import Any

import numpy as np
from typing_extensions import override

_KEPT = 0.8  # Share of discrete draws that a move leaves as they are.


class NormalPoint:
    """Standard normal numbers z (n,) that an episode reads; a generator draws the rest."""

    def __init__(self, rng: np.random.Generator, z: np.ndarray | None = None):
        self._rng, self._z = rng, [] if z is None else z.tolist()
        self._is_discrete: list[bool] = []

    @property
    def z(self) -> np.ndarray:
        """The numbers that were read, in the order of the draws, (n,)."""
        return np.array(self._z[: len(self._is_discrete)])

    @property
    def is_discrete(self) -> np.ndarray:
        """Which of them decided a discrete draw, (n,)."""
        return np.array(self._is_discrete, dtype=bool)

    def read(self, size: int, is_discrete: bool) -> np.ndarray:
        """Reads the next numbers, (size,)."""
        first, end = len(self._is_discrete), len(self._is_discrete) + size
        if end > len(self._z):
            self._z += self._rng.standard_normal(end - len(self._z)).tolist()
        self._is_discrete += [is_discrete] * size
        return np.array(self._z[first:end])


class NormalGenerator(np.random.Generator):
    """A generator that reads a `NormalPoint`, in the order of the calls.

    A uniform draw is Φ(z), another one its distribution's inverse of Φ(z), so that a small move of
    the point changes an episode a little. Methods without such a function raise a ValueError.
    """

    def __init__(self, point: NormalPoint):
        super().__init__(np.random.PCG64(0))
        self._point = point

    def _normals(self, size: Any, *parameters: Any, is_discrete: bool = False) -> Any:
        shape = np.broadcast(*parameters).shape if size is None and parameters else size
        if shape is None or shape == ():
            return self._point.read(1, is_discrete)[0]
        shape = (shape,) if isinstance(shape, int | np.integer) else tuple(shape)
        return self._point.read(int(np.prod(shape)), is_discrete).reshape(shape)

    def _uniforms(self, size: Any, *parameters: Any, is_discrete: bool = False) -> Any:
        from scipy.special import ndtr

        # Below 1, as of any generator.
        uniforms = ndtr(self._normals(size, *parameters, is_discrete=is_discrete))
        return np.minimum(uniforms, np.nextafter(1.0, 0.0))

    @override
    def standard_normal(self, size: Any = None) -> Any:  # type: ignore[override]
        return self._normals(size)

    @override
    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        return loc + np.asarray(scale) * self._normals(size, loc, scale)

    @override
    def random(self, size: Any = None) -> Any:  # type: ignore[override]
        return self._uniforms(size)

    @override
    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        return low + (np.asarray(high) - low) * self._uniforms(size, low, high)

    @override
    def exponential(self, scale: Any = 1.0, size: Any = None) -> Any:
        return -np.asarray(scale) * np.log1p(-self._uniforms(size, scale))

    @override
    def integers(  # type: ignore[override]
        self, low: Any, high: Any = None, size: Any = None, *, endpoint: bool = False
    ) -> Any:
        low, high = (0, low) if high is None else (low, high)
        width = np.asarray(high) - low + int(endpoint)
        uniforms = self._uniforms(size, low, high, is_discrete=True)
        return (low + np.floor(width * uniforms).astype(np.int64))[()]

    @override
    def choice(  # type: ignore[override]
        self, a: Any, size: Any = None, replace: bool = True, p: Any = None
    ) -> Any:
        pool = np.arange(a) if np.ndim(a) == 0 else np.asarray(a)
        if not replace and size is not None:
            if p is not None:
                raise ValueError(_REFUSED.format("choice(replace=False, p=...)"))
            return self.permutation(pool)[: int(np.prod(size))].reshape(size)
        share = np.ones(len(pool)) if p is None else np.asarray(p, dtype=float)
        ends = np.cumsum(share / share.sum())[:-1]
        return pool[np.searchsorted(ends, self._uniforms(size, is_discrete=True), side="right")]

    @override
    def permutation(self, x: Any) -> Any:  # type: ignore[override]
        pool = np.arange(x) if np.ndim(x) == 0 else np.asarray(x)
        return pool[np.argsort(self._normals(len(pool), is_discrete=True))]

    @override
    def shuffle(self, x: Any) -> None:  # type: ignore[override]
        x[:] = self.permutation(x)

    @override
    def spawn(self, n_children: int) -> Any:
        return [self] * n_children  # Their numbers follow in the order of the calls.


_KNOWN = sorted(name for name in vars(NormalGenerator) if not name.startswith("_"))
_REFUSED = (
    f"in a search for rare failures, an episode draws by the generator's methods {_KNOWN}; got "
    "'{}': draw it by one of these"
)


def _refuse(name: str) -> Any:
    def refused(self: NormalGenerator, *args: Any, **options: Any) -> Any:
        raise ValueError(_REFUSED.format(name))

    return refused


for _name in {*dir(np.random.Generator)} - {*_KNOWN, "bit_generator"}:
    if not _name.startswith("_"):
        setattr(NormalGenerator, _name, _refuse(_name))


def moved(
    z: np.ndarray, is_discrete: np.ndarray, step: float, rng: np.random.Generator
) -> np.ndarray:
    """A point near z (n,) by a move that keeps the standard normal distribution.

    It is ``sqrt(1 - step²) z + step ε`` (Cotter et al. 2013); most discrete draws stay.
    """
    near = np.sqrt(1.0 - step**2) * z + step * rng.standard_normal(len(z))
    return np.where(is_discrete & (rng.random(len(z)) < _KEPT), z, near)
