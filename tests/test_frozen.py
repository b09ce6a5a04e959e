"""Classes that are defined without generated code behave like those of the standard library."""

import copy
import dataclasses
import inspect
import pickle
import typing

import pytest

from wholearm.common.frozen import NamedTuple, dataclass


@dataclass(frozen=True)
class Point:
    """A point."""

    x: float
    y: float = 2.0
    tags: list[str] = dataclasses.field(default_factory=list, compare=False, repr=False)
    size: float = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", self.x + self.y)


@dataclasses.dataclass(frozen=True)
class Model:
    """The same, by the standard library."""

    x: float
    y: float = 2.0
    tags: list[str] = dataclasses.field(default_factory=list, compare=False, repr=False)
    size: float = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", self.x + self.y)


@dataclass(frozen=True, eq=False)
class Thing:
    """Equal to itself only."""

    x: float


class Pair(NamedTuple):
    """A named tuple."""

    first: int
    second: "int" = 3

    @property
    def total(self) -> int:
        """Their sum."""
        return self.first + self.second


@pytest.mark.parametrize("kind", [Point, Model])
def test_values_are_taken_compared_shown_and_kept(kind: type[Point]) -> None:
    point = kind(1.0, tags=["a"])
    assert (point.x, point.y, point.tags, point.size) == (1.0, 2.0, ["a"], 3.0)
    assert kind(1.0).tags == [] and kind(1.0).tags is not kind(1.0).tags
    assert point == kind(x=1.0) and hash(point) == hash(kind(1.0)) and point != kind(1.0, 1.0)
    other: object = Thing(1.0)
    assert point != other
    assert repr(point) == f"{kind.__name__}(x=1.0, y=2.0, size=3.0)"
    with pytest.raises(dataclasses.FrozenInstanceError, match="field 'x'"):
        setattr(point, "x", 0.0)  # noqa: B010 -- a type checker knows
    with pytest.raises(dataclasses.FrozenInstanceError, match="field 'x'"):
        delattr(point, "x")
    assert dataclasses.replace(point, x=3.0).size == 5.0
    assert dataclasses.asdict(point) == {"x": 1.0, "y": 2.0, "tags": ["a"], "size": 3.0}
    assert pickle.loads(pickle.dumps(point)) == copy.deepcopy(point) == point


@pytest.mark.parametrize("kind", [Point, Model])
@pytest.mark.parametrize(
    "given", [((), {}), ((1, 2, [], 4), {}), ((1,), {"x": 1}), ((1,), {"z": 1})]
)
def test_wrong_values_are_type_errors(
    kind: type[Point], given: tuple[tuple[float, ...], dict[str, float]]
) -> None:
    with pytest.raises(TypeError):
        kind(*given[0], **given[1])  # type: ignore[arg-type]


def test_signatures_are_those_of_the_standard_library() -> None:
    own, model = inspect.signature(Point), inspect.signature(Model)
    assert list(own.parameters) == list(model.parameters)
    assert own.parameters["y"].default == 2.0


def test_without_equality_things_are_themselves() -> None:
    assert Thing(1.0) != Thing(1.0)
    assert len({Thing(1.0), Thing(1.0)}) == 2


def test_classes_that_are_not_frozen_are_left_to_the_standard_library() -> None:
    with pytest.raises(ValueError, match="not frozen"):
        dataclass(frozen=False)


def test_named_tuples_are_tuples_with_defaults_and_methods() -> None:
    pair = Pair(1)
    assert isinstance(pair, tuple) and pair == (1, 3) and pair.total == 4
    assert pair._replace(first=2) == Pair(2, 3) and Pair.__doc__ == "A named tuple."
    assert pickle.loads(pickle.dumps(pair)) == pair
    assert Pair._fields == typing.NamedTuple("Model", [("first", int), ("second", int)])._fields
