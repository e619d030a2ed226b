"""Each file in configs/ can be read as it is, and the docs say what it is for."""

import tomllib
from pathlib import Path

import pytest

from jaxevent.runs import evaluate, fit_config

ROOT = Path(__file__).parents[2]
CONFIGS = sorted((ROOT / "configs").glob("*.toml"))


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.stem)
def test_configurations_are_read(config, tmp_path, monkeypatch):
    for name in ("AHDR", "AKF_HDR", "IJRR", "RIGS", "JAXEVENT_DATA", "DEMONSTRATION"):
        monkeypatch.setenv(name, str(tmp_path))
    drawn = [f"{name}/{part}" for name in ("noises", "r_t") for part in ("fit", "test")]
    for part in ("fit", "validation", "test", ".", *drawn):
        (tmp_path / part).mkdir(parents=True, exist_ok=True)
        (tmp_path / part / f"of_{Path(part).name}.h5").touch()
    (tmp_path / "fitted").mkdir()
    (tmp_path / "fitted" / "params.toml").write_text("[akf]\nc_on = 0.3\n")
    table = tomllib.loads(config.read_text())
    if config.stem.startswith("fit_"):
        labels = [task.label for task in fit_config.read_plan(config).tasks]
    else:
        labels = [entry.label for entry in evaluate.read_plan(config).methods]
    assert labels == [one.get("label", one["name"]) for one in table["method"]]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.stem)
def test_the_docs_name_each_configuration(config):
    pages = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "experiments").glob("*.py")]
    assert any(f"configs/{config.name}" in page.read_text() for page in pages)
