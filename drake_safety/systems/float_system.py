"""FloatSystem: what systems of floats can offer of Drake's cloning and scalar conversion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn, Self


class FloatSystem:
    """A system, or a diagram, that is built anew to be cloned and has no other scalar type.

    Drake clones by scalar conversion, of which systems written in Python are no part unless they
    are templates on the scalar type. Those here cannot be: they ask networks, QP solvers and a
    MultibodyPlant of floats. :meth:`Clone` therefore calls the constructor again with the same
    arguments. What is immutable, or was passed in, is shared: a robot's kinematics keeps a
    scratch Context, so clones do not belong in different threads. Drake's own ``Diagram.Clone()``
    and ``copy.deepcopy`` of a diagram with such a system in it still raise.

    Comes before the Drake class among the bases: ``class Planner(FloatSystem, LeafSystem)``.
    """

    _constructed_with: tuple[tuple[Any, ...], dict[str, Any]]
    get_name: Callable[[], str]  # Drake's.
    set_name: Callable[[str], None]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keeps the arguments, whatever the constructor makes of them."""
        system = super().__new__(cls, *args, **kwargs)
        system._constructed_with = args, kwargs
        return system

    def Clone(self) -> Self:
        """Another system of the same constructor arguments and name."""
        args, kwargs = self._constructed_with
        clone = type(self)(*args, **kwargs)
        clone.set_name(self.get_name())
        return clone

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.Clone()

    def ToAutoDiffXd(self) -> NoReturn:
        """Raises `TypeError`, which says why."""
        self._refuse("AutoDiffXd")

    def ToSymbolic(self) -> NoReturn:
        """Raises `TypeError`, which says why."""
        self._refuse("symbolic Expression")

    def _refuse(self, scalar: str) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__} cannot be converted to {scalar}: it is evaluated on floats "
            f"only (networks, QP solvers, a MultibodyPlant of floats)"
        )
