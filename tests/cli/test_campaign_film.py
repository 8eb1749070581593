"""Films of run 0 of a campaign, by the command line."""

from jaxslam import cli
from jaxslam.results.film import encoding


def test_a_campaign_is_filmed_also_when_it_is_finished(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(encoding, "ffmpeg", lambda: None)
    out = tmp_path / "out"
    run = ["consistency", "--scenario", "stationary", "--steps", "3", "--runs", "2"]
    run += ["--filters", "dead_reckoning", "--figures", "pdf", "--devices", "1", "--out", str(out)]
    assert cli.main(run) == 0 and not list(out.glob("film*"))
    again = ["consistency", "--resume", str(out), "--figures", "pdf", "--devices", "1", "--animate"]
    assert cli.main(again) == 0
    printed = capsys.readouterr().out
    assert "\nfilm: ffmpeg is not installed: GIF instead of MP4\n" in printed
    assert (out / "film-dead_reckoning.gif").read_bytes().startswith(b"GIF")
    page = (out / "film-dead_reckoning.html").read_text()
    assert "stationary: dead_reckoning, run 0 of seed 0" in page
