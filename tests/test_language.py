"""Names and docstrings of the package keep the rules that `experiments/code_counts.py` counts."""

import ast
import textwrap

import pytest
from scripts import script

MOST_LONG_SIGNATURES = 20
MOST_OPEN_SIGNATURES = 0
MOST_OPEN_FIELDS = 0


code_counts = script("code_counts")


@pytest.fixture(scope="module")
def broken():
    return code_counts.broken_rules(code_counts.files_of("jaxevent"))


@pytest.mark.parametrize(
    "rule",
    [
        "docstring begins badly",
        "public surface without docstring",
        "public surface without Args or Returns",
        "class is no noun",
        "word of the old glossary",
        "text names an unknown constant",
    ],
)
def test_no_place_breaks_a_rule(broken, rule):
    assert broken[rule] == []


def test_few_functions_take_many_arguments(broken):
    found = broken["more than six positional arguments"]
    assert len(found) <= MOST_LONG_SIGNATURES
    assert not [place for place in found if "no reason" in place]
    assert len(found) == len(code_counts.LONG_SIGNATURES)


def test_shapes_and_units_are_documented(broken):
    assert len(broken["shape or unit open without Args"]) <= MOST_OPEN_SIGNATURES
    assert len(broken["field without unit"]) <= MOST_OPEN_FIELDS


@pytest.mark.parametrize(
    "text, are_open",
    [
        ('def f(a: Float[Array, "n"], n: int):\n    "Add."', []),
        ('def f(a: NDArray, n: int):\n    "Add."', ["a"]),
        ('def f(a, n: int):\n    "Add."', ["a"]),
    ],
)
def test_open_annotations(tmp_path, text, are_open):
    (tmp_path / "one.py").write_text(text)
    (one,) = code_counts.definitions_of(tmp_path / "one.py")
    assert one.open_arguments == are_open
    assert code_counts.needs_arguments(one) == bool(are_open)


def test_fields_without_unit(tmp_path):
    text = 'class A:\n    "Has `c`."\n    a: float  # s\n    b: float\n    c: float\n    d: int\n'
    (tmp_path / "one.py").write_text(text)
    (one,) = code_counts.definitions_of(tmp_path / "one.py")
    assert code_counts.unexplained_fields(one) == ["b"]


def test_lines_of_code_are_counted_without_text_about_it():
    text = textwrap.dedent('''
        """A module."""

        # A comment.
        def add(a, b):
            """Add."""
            return (
                a + b  # of both
            )
    ''')
    assert code_counts.count_code_lines(text) == 4


@pytest.mark.parametrize(
    "docstring, is_bad",
    [("What it is.", True), ("As `run`.", True), ("Assign events.", False), ("Offset, s.", False)],
)
def test_beginnings_of_docstrings(docstring, is_bad):
    assert code_counts.begins_badly(docstring) == is_bad


@pytest.mark.parametrize(
    "name, is_bad", [("Told", True), ("FitResult", False), ("Blended", True), ("Recording", False)]
)
def test_names_of_classes(name, is_bad):
    assert code_counts.is_no_noun(name) == is_bad


def test_arguments_and_publicity_of_a_definition(tmp_path, monkeypatch):
    monkeypatch.setattr(code_counts, "ROOT", tmp_path)
    path = tmp_path / "some.py"
    path.write_text("class A:\n    def f(self, a, b, *, c):\n        def g(): ...\n")
    kind, method, inner = code_counts.definitions_of(path)
    assert isinstance(kind.node, ast.ClassDef) and kind.is_public and method.is_public
    assert method.arguments == ["a", "b"] and method.keywords == ["c"]
    assert not inner.is_public
