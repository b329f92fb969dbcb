"""FloatSystem: cloning of systems that support no scalar conversion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn, Self


class FloatSystem:
    """A system or diagram of scalar type float that is cloned by calling its constructor again.

    Drake clones by scalar conversion, which systems written in Python support only as templates on
    the scalar type. The systems of this package evaluate networks, QP solvers and a MultibodyPlant
    of floats, so :meth:`Clone` calls the constructor with the same arguments. Objects passed to the
    constructor are shared. They keep scratch memory for every thread, so that one diagram can be
    simulated in several threads, each with its own Context. Drake's own ``Diagram.Clone()`` and
    ``copy.deepcopy`` of a diagram with such a system still raise.

    Must precede the Drake class among the bases: ``class Planner(FloatSystem, LeafSystem)``.
    """

    _constructed_with: tuple[tuple[Any, ...], dict[str, Any]]
    get_name: Callable[[], str]  # Drake's.
    set_name: Callable[[str], None]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Stores the constructor's arguments."""
        system = super().__new__(cls, *args, **kwargs)
        system._constructed_with = args, kwargs
        return system

    def Clone(self) -> Self:
        """Returns a new system with the same constructor arguments and name."""
        args, kwargs = self._constructed_with
        clone = type(self)(*args, **kwargs)
        clone.set_name(self.get_name())
        return clone

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.Clone()

    def ToAutoDiffXd(self) -> NoReturn:
        """Raises `TypeError`."""
        self._refuse("AutoDiffXd")

    def ToSymbolic(self) -> NoReturn:
        """Raises `TypeError`."""
        self._refuse("symbolic Expression")

    def _refuse(self, scalar: str) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__} cannot be converted to {scalar}: it is evaluated on floats "
            f"only (networks, QP solvers, a MultibodyPlant of floats)"
        )
