"""Names and docstrings of the package keep the rules that `experiments/code_counts.py` counts."""

import ast
import textwrap

import pytest
from scripts import script

MOST_LONG_SIGNATURES = 20


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
    assert len(broken["more than six positional arguments"]) <= MOST_LONG_SIGNATURES


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
