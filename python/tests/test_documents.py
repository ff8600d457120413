"""The cookbook and the notebook do what they say."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbclient
import nbformat
import numpy as np
import pytest
import trustme
from service import ROOT, Service

import polscan

ADDRESS = "http://127.0.0.1:8631"


def blocks(text: str) -> list[tuple[str, int, str]]:
    """Language, line and code of each block."""
    found = re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [(one[1], text[: one.start(2)].count("\n") + 1, one[2]) for one in found]


def test_every_block_of_the_cookbook_runs(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "docs" / "python.md").read_text()
    monkeypatch.chdir(tmp_path)
    trustme.CA().cert_pem.write_to_path("lab-ca.pem")
    run: list[str] = []
    known: dict[str, object] = {"__name__": "cookbook"}
    for language, line, code in blocks(text):
        code = code.replace(ADDRESS, service.url)
        if language == "python":
            # As if it stood in the document, so that a failure names the line.
            program = compile("\n" * (line - 1) + code, "docs/python.md", "exec")
            exec(program, known)  # noqa: S102 - that is what it is for
        elif language == "sh":
            path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
            subprocess.run(code, shell=True, check=True, env={**os.environ, "PATH": path})  # noqa: S602
        else:
            assert language == "console", f"line {line}: who runs {language}?"
        run.append(language)
    assert (run.count("python"), run.count("sh")) == (17, 1)
    told = capsys.readouterr().out
    assert "nothing-lit" in told
    assert "mm" in told
    assert polscan.open_bundle("part-7").report().verdict == "ok"


def test_the_notebook_measures_what_the_report_says(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notebook: Any = nbformat.read(ROOT / "examples" / "flatness.ipynb", as_version=4)
    nbformat.validate(notebook)
    assert all(not cell.get("outputs") for cell in notebook.cells), "the notebook is kept without outputs"
    shown = len(notebook.cells)
    notebook.cells.append(
        nbformat.v4.new_code_cell(
            "import json\n"
            "print(json.dumps({'id': scan.id, 'rms': rms_mm, 'flat': flatness_mm, 'expected': expected_mm}))"
        )
    )
    monkeypatch.setenv("POLSCAN_URL", service.url)
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    client = nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    outputs = [output for cell in notebook.cells[:shown] for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 2
    found = json.loads(notebook.cells[-1].outputs[0].text)
    bundle = polscan.open_bundle(service.store / found["id"])
    cloud, maps, truth = bundle.cloud(), bundle.maps(), bundle.truth()
    height, width = maps["mask"].shape
    y, x = np.nonzero(maps["mask"])
    plate = (x > 0.55 * width) & (x < 0.97 * width) & (y > 0.05 * height) & (y < 0.95 * height)
    # The same by another way: how far each depth is off the truth, seen across the plate as the scene describes it.
    normal = np.array([0.05, 0.02, -1.0]) / np.linalg.norm([0.05, 0.02, -1.0])
    points = np.stack([cloud[name] for name in "xyz"], axis=-1).astype(float)[plate]
    off_mm = (maps["depth"] - truth["depth"])[y[plate], x[plate]] * (points @ normal) / points[:, 2]
    assert found["rms"] == pytest.approx(np.sqrt(np.mean(off_mm.astype(float) ** 2)), rel=0.05)
    # The plate of the simulated rig is flat: noise explains what is seen.
    assert found["rms"] == pytest.approx(found["expected"], rel=0.2)
    # 95 % of a bell curve lie within 1.96 standard deviations on either side; here sigma varies a little.
    assert found["flat"] == pytest.approx(2 * 1.96 * found["rms"], rel=0.15)
