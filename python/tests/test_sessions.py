"""Sessions that calibrate the rig with a board."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import MakeService

import polscan
from polscan import Scanner

BOARD = {"pattern": {"checkerboard": {"columns": 9, "rows": 6, "square_mm": 18.0}}}


def test_a_session_goes_on_over_refusal_and_restart(make_service: MakeService, tmp_path: Path) -> None:
    service = make_service().start()
    described = tmp_path / "board.toml"
    described.write_text("[pattern.checkerboard]\ncolumns = 9\nrows = 6\nsquare_mm = 18.0\n")
    with Scanner(service.url) as scanner:
        scanner.wait_ready(30)
        session = scanner.calibrate_rig(described)
        assert (session.info.kind, session.info.state) == ("rig", "open")
        assert session.info.session is not None
        assert session.info.session.views == ()
        view = session.take_view(60)
        assert view.corners >= 8
        assert view.unusable is None
        state = session.info.session
        assert state.missing
        assert state.views == (view,)
        assert sum(map(sum, state.camera_coverage)) == view.corners
        with pytest.raises(polscan.Conflict):
            scanner.calibrate_rig(BOARD)

        with pytest.raises(polscan.CalibrationFailed) as refused:
            session.solve(60)
        assert "view" in refused.value.info.refused[0]
        assert session.solve(60, check=False).accepted is False

        session.take_view(60)
        info = session.drop_view("view-01", 60)
        assert info.session is not None
        assert [view.name for view in info.session.views] == ["view-02"]
        with pytest.raises(polscan.NotFound):
            session.drop_view("view-99")

        service.stop()
        service.start()
        again = scanner.calibration(session.id)
        assert again.info == session.refresh()
        while len(again.settled(60).session.views) < 10:  # type: ignore[union-attr]
            again.take_view(60)
        done = again.solve(120)
        assert (done.state, done.accepted) == ("done", True)
        assert again.fetch("calibration.toml", tmp_path).stat().st_size > 0
        assert json.loads(again.read("report.json"))["accepted"] is True


def test_faults_of_a_board_are_told_before_anything_begins(scanner: Scanner) -> None:
    with pytest.raises(polscan.Invalid) as refused:
        scanner.calibrate_rig({"pattern": {"checkerboard": {"columns": 1, "rows": 6, "square_mm": 18.0}}})
    assert "board" in str(refused.value)
    with pytest.raises(polscan.Invalid):
        scanner.calibrate_rig(BOARD, baseline_mm=-1.0)
