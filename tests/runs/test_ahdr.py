"""The script of HDR scenes scores fitted methods by the numbers of a fit, not by defaults."""

import sys

import pytest
from scripts import script


@pytest.fixture
def folder(tmp_path):
    """Return a folder whose fit has the filter's numbers alone."""
    (tmp_path / "fitted").mkdir()
    (tmp_path / "fitted" / "params.toml").write_text("[akf]\nc_on = 0.3\n")
    return tmp_path


@pytest.mark.parametrize(
    ("method", "missing"),
    [
        ("aks", "aks"),
        ("mc", "aks"),
        ("akf, the paper's constants", "akf, the paper's constants"),
    ],
)
def test_a_fit_that_lacks_a_method_is_refused(folder, monkeypatch, capsys, method, missing):
    line = ["ahdr.py", "--out", str(folder), "--methods", "akf", method, "--seeds", "0"]
    monkeypatch.setattr(sys, "argv", line)
    with pytest.raises(SystemExit):
        script("ahdr").main()
    assert f"params.toml has no parameters of {missing}: give" in capsys.readouterr().err
    assert not (folder / "test").exists()


def test_a_fit_that_has_all_methods_is_taken(folder, monkeypatch):
    line = ["ahdr.py", "--out", str(folder), "--methods", "akf", "blend", "--seeds", "0"]
    monkeypatch.setattr(sys, "argv", line)
    script("ahdr").main()
    assert (folder / "table.md").exists()
    (_, _, params), _ = script("ahdr").choose(["akf", "blend"], folder / "fitted" / "params.toml")
    assert float(params.c_on) == pytest.approx(0.3)
