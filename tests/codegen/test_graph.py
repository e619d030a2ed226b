import numpy as np
import pytest

from jaxevent.codegen.graph import ELEMENTWISE_FUNCTIONS, Graph, Level, Node


def value(node: Node, given: dict[str, float]) -> float:
    """What a node is for values of the inputs."""
    if node.op == "constant":
        return {"f": float, "i": int, "b": "True".__eq__}[node.kind](node.args[0])
    if node.op == "input":
        return given[node.args[0]]
    args = [value(a, given) for a in node.args]
    if node.op == "select_n":
        return args[1 + bool(args[0])]
    return float(args[0]) if node.op == "to_f" else ELEMENTWISE_FUNCTIONS[node.op](*args)


@pytest.mark.parametrize("truth", [False, True])
def test_what_is_supposed_is_folded_into_the_results(truth):
    graph = Graph()
    x, y = (graph.input(name, "f", Level.POINT) for name in "xy")
    hit = graph.apply("lt", (x, y), "b")
    number = graph.apply("to_f", (hit,), "f")
    share = graph.apply("select_n", (graph.apply("gt", (number, graph.constant(0.0)), "b"),
        graph.constant(7.0), number), "f")  # fmt: skip
    result = graph.apply("add", (graph.apply("mul", (share, x), "f"), y), "f")
    made = graph.assume_truth({"a": result}, hit, truth)["a"]
    given = {"x": 1.5, "y": 2.0 if truth else 1.0}
    assert value(made, given) == value(result, given)
    assert made.op == "add" and (made.args[0] is x) == truth  # the number is a constant


@pytest.mark.parametrize("op", ["lt", "le", "gt", "ge", "eq", "ne"])
@pytest.mark.parametrize("bound", [-1.0, 0.0, 0.5, 1.0])
def test_numbers_of_truth_values_are_compared_without_them(op, bound):
    graph = Graph()
    hit = graph.input("hit", "b", Level.POINT)
    made = graph.apply(op, (graph.apply("to_f", (hit,), "f"), graph.constant(bound)), "b")
    assert made.op in ("input", "not", "constant")
    for given in (False, True):
        assert bool(value(made, {"hit": given})) == bool(
            ELEMENTWISE_FUNCTIONS[op](float(given), bound)
        )


def test_a_choice_of_0_and_1_is_a_number():
    graph = Graph()
    hit = graph.input("hit", "b", Level.POINT)
    made = graph.apply("select_n", (hit, graph.constant(0.0), graph.constant(1.0)), "f")
    assert made.op == "to_f" and made.args[0] is hit
    assert np.isclose(value(made, {"hit": True}), 1)
