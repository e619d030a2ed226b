"""Derivatives of a pixel's state and image along directions in the parameters, side by side.

The change of a state is a sum: of changes of the state before, of what the frames say, and of
numbers, each times a factor that is the same for all directions (`codegen.linear`). So a pixel has
a record of vectors, one number for each direction.
"""

import dataclasses
import functools
from typing import Any

from jaxevent.codegen.expressions import Graph, Node, Untranslatable, needed, value_of
from jaxevent.codegen.linear import factors

Table = list[Node]


@dataclasses.dataclass(frozen=True)
class Change:
    """A vector of changes, nothing along directions that are not named."""

    kind: str  # of a "state", of a "table" (what frames say), or of a "number"
    state: int  # which
    nodes: dict[int, list[Node]]  # numbers to add up; or what the table holds in each variant


@dataclasses.dataclass(frozen=True)
class Slopes:
    """How changes of results are made of others."""

    changes: list[Change]
    factors: dict[str, list[tuple[Node, int]]]  # by the result's name: factor, place in `changes`

    def factors_of(self, *names: str) -> list[Node]:
        """The factors of some results, each once."""
        return list(dict.fromkeys(node for name in names for node, _ in self.factors[name]))


def slopes_of(
    outs: dict[str, list[Node]],
    tables: list[Table],
    excess: list[Node],
    moving: set[Node],
    graph: Graph,
) -> Slopes:
    """The derivatives of results, by direction; raises `Untranslatable`.

    `moving` are the changes of numbers of the parameters.
    """
    sums = {f"_{k}" for k, node in enumerate(excess) if moving & set(needed([node]))}

    def changes(node: Node) -> bool:
        name = str(node.args[0]) if node.op == "input" else ""
        if node.op == "slot":
            below = needed([table[node.args[0]] for table in tables])
            return any(changes(n) for n in below)
        ours = name.startswith("slope") or (name.startswith("total") and name[6:] in sums)
        return ours or node in moving

    every = needed([node for nodes in outs.values() for node in nodes])
    known = {node for node in every if changes(node)}
    # The factors of a change in all results: what has the same ones is one vector.
    found: dict[tuple[int, Node], dict[str, Node]] = {}
    for name, nodes in outs.items():
        for direction, node in enumerate(nodes):
            for change, factor in factors(node, known, graph).items():
                found.setdefault((direction, change), {})[name] = factor
    vectors: dict[tuple[Any, ...], dict[int, list[Node]]] = {}
    alike: dict[tuple[Any, ...], dict[str, Node]] = {}
    for (direction, change), by_name in found.items():
        key = _kind(change)
        if key[0] == "state":
            alike.setdefault(key, {})
            if any(alike[key].setdefault(n, f) is not f for n, f in by_name.items()):
                raise Untranslatable("derivatives whose factors differ between directions")
        else:
            key += tuple((n, f.number) for n, f in sorted(by_name.items()))
            alike[key] = by_name
        vectors.setdefault(key, {}).setdefault(direction, []).append(change)
    order = sorted(vectors, key=lambda key: ("state", "table", "number").index(key[0]))
    made: list[Change] = []
    terms: dict[str, dict[int, Node]] = {name: {} for name in outs}
    for key in order:
        kind, state = key[:2]
        change = Change(kind, state, _contents(kind, vectors[key], tables, graph))
        if change not in made:
            made.append(change)
        place = made.index(change)
        for name, factor in alike[key].items():
            before = terms[name].get(place, graph.constant(0.0))
            terms[name][place] = graph.apply("add", (before, factor), "f")
    sums = {
        name: [(factor, place) for place, factor in by_place.items() if value_of(factor) != 0]
        for name, by_place in terms.items()
    }
    return Slopes(made, sums)


def _contents(
    kind: str, changes: dict[int, list[Node]], tables: list[Table], graph: Graph
) -> dict[int, list[Node]]:
    def total(nodes: list[Node]) -> Node:
        return functools.reduce(lambda a, b: graph.apply("add", (a, b), "f"), nodes)

    if kind == "state":
        return {}
    if kind == "number":
        return changes
    return {
        lane: [total([table[slot.args[0]] for slot in slots]) for table in tables]
        for lane, slots in changes.items()
    }


def _kind(change: Node) -> tuple[Any, ...]:
    if change.op == "input" and str(change.args[0]).startswith("slope"):
        return "state", int(change.args[0].removeprefix("slope").partition("_")[0])
    if change.op not in ("number", "slot"):
        raise Untranslatable(f"the derivative of {change.op!r} at a point")
    return "number" if change.op == "number" else "table", -1
