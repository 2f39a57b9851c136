"""Named tuples that are static arguments of compiled functions."""

from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


def hashed_by_type(cls: Class) -> Class:
    """Make tuples of this class equal to tuples of this class only.

    By themselves tuples are equal by their values alone: as a static argument a ramp would be taken for a constant
    offset of the same numbers, and its compiled program used.
    """

    def same(self: tuple[Any, ...], other: object) -> bool:
        return type(self) is type(other) and tuple(self) == tuple(other)

    def differs(self: tuple[Any, ...], other: object) -> bool:
        return not same(self, other)

    def code(self: tuple[Any, ...]) -> int:
        return hash((cls.__name__, *self))

    for name, method in (("__eq__", same), ("__ne__", differs), ("__hash__", code)):
        setattr(cls, name, method)
    return cls
