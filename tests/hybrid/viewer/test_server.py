"""The server: who is answered, with what, and what no address can reach."""

import http.client
import json
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np
import pytest

from hybrid.viewer.sequence import Sequence
from hybrid.viewer.server import ViewServer
from tests.scenes import Scene

COMBINED = quote("ViewLayer.Combined")


@pytest.fixture
def served(tmp_path):
    """Two finished frames beside three noisy ones, served."""
    out = Scene(frames=2).write(tmp_path / "out", clean=True)
    noisy = Scene().write(tmp_path / "noisy")
    (tmp_path / "secret.txt").write_text("secret", encoding="utf-8")
    with ViewServer([Sequence(str(out), finished=True), Sequence(str(noisy), finished=False)], rate=25) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield server
        server.shutdown()


def ask(server, path, *, host=None, method="GET", secret=True):
    """Status, headers and body of an address below the secret one, sent as it is."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    connection.putrequest(method, f"/{server.secret}/{path}" if secret else path, skip_host=True)
    if host != "":
        connection.putheader("Host", host or f"127.0.0.1:{server.port}")
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), body


def test_the_state_lists_frames_layers_and_rate(served):
    status, headers, body = ask(served, "state")
    assert (status, headers["Content-Type"]) == (200, "application/json")
    state = json.loads(body)
    out, noisy = state["sequences"]
    assert state["rate"] == 25
    assert (out["name"], list(out["frames"])) == ("out", ["1001", "1002"])
    assert (noisy["name"], list(noisy["frames"])) == ("noisy", ["1001", "1002", "1003"])
    assert "ViewLayer.Denoising Normal" in out["layers"]
    assert out["layer"] == "ViewLayer.Combined"


def test_equal_names_are_told_apart(tmp_path):
    folders = [Scene(frames=1).write(tmp_path / name) for name in ("noisy", "denoised")]
    specs = [Sequence(str(folder / "shot.####.exr"), finished=False) for folder in folders]
    with ViewServer(specs) as server:
        names = [sequence["name"] for sequence in server.state()["sequences"]]
    assert names == ["noisy/shot.####.exr", "denoised/shot.####.exr"]


def test_sequences_of_a_folder_follow_those_that_are_named(served, tmp_path):
    assert [each["name"] for each in served.state()["sequences"]] == ["out", "noisy"]
    for name in ("other.1001.exr", "other.1002.exr"):
        (tmp_path / "out" / name).write_bytes((tmp_path / "out" / name.replace("other", "shot")).read_bytes())
    for _ in range(2):
        sequences = served.state()["sequences"]
        assert [each["name"] for each in sequences] == ["shot.####.exr", "noisy", "other.####.exr"]
        assert [*sequences[0]["frames"]] == [*sequences[2]["frames"]] == [1001, 1002]
    assert ask(served, f"frame/2/1001.png?layer={COMBINED}&ev=0")[0] == 200


def test_a_sequence_that_cannot_be_read_is_said_beside_the_others(served, monkeypatch):
    def refuse(self):
        raise ValueError("two files have one number")

    said = []
    monkeypatch.setattr(served, "_report", said.append)
    monkeypatch.setattr(served.sequences[1], "versions", refuse.__get__(served.sequences[1]))
    for _ in range(2):
        out, noisy = served.state()["sequences"]
    assert (out["error"], len(out["frames"])) == ("", 2)
    assert (noisy["error"], noisy["frames"]) == ("two files have one number", {})
    assert len(said) == 1


def test_a_bug_is_one_line_of_the_terminal_and_an_answer(served, monkeypatch):
    said = []
    monkeypatch.setattr(served, "_report", said.append)
    monkeypatch.setattr(Sequence, "facts", lambda *_: 1 / 0)
    for _ in range(2):
        assert ask(served, "facts/0/1001.json")[0] == 500
    assert [str(error) for error in said] == ["division by zero"]


def test_frames_are_pictures_with_one_exposure(served):
    """Both sequences are exposed by the noisy one's middle frame, to a mean of 0.18."""
    status, headers, body = ask(served, f"frame/0/1001.png?layer={COMBINED}&ev=0&version=x")
    assert (status, headers["Content-Type"]) == (200, "image/png")
    assert "immutable" in headers["Cache-Control"]
    shown = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255
    linear = np.where(shown > 0.04045, ((shown + 0.055) / 1.055) ** 2.4, shown / 12.92)
    truth = Scene().clean(0)["ViewLayer.Combined"]
    gain = np.median(linear / truth)
    # The measure of exposure is robust and the picture noisy: within a fifth of the mean's own.
    assert gain == pytest.approx(0.18 / Scene().clean(1)["ViewLayer.Combined"].mean(), rel=0.2)
    brighter = cv2.imdecode(
        np.frombuffer(ask(served, f"frame/0/1001.png?layer={COMBINED}&ev=1")[2], np.uint8), cv2.IMREAD_COLOR
    )
    assert brighter.mean() > shown.mean() * 255 * 1.2
    assert ask(served, f"frame/1/1003.jpg?layer={COMBINED}&ev=0")[1]["Content-Type"] == "image/jpeg"


def test_the_page_may_load_nothing_from_elsewhere(served):
    for path in ("", "page.css", "page.js"):
        status, headers, body = ask(served, path)
        assert status == 200
        assert body
        assert headers["Content-Security-Policy"].startswith("default-src 'none'")
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert b"http:" not in body.replace(b"http://www.w3.org", b"")
        assert b"https:" not in body


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:{port}", ""]
)
def test_another_host_is_refused(served, host):
    """A page whose name was pointed at this machine sends its own name."""
    assert ask(served, "state", host=host.format(port=served.port))[0] == 403


def test_localhost_is_this_server_too(served):
    assert ask(served, "state", host=f"localhost:{served.port}")[0] == 200


@pytest.mark.parametrize("path", ["/", "/state", "/page.js", "/wrong/state", "//state", "/favicon.ico"])
def test_nothing_is_given_without_the_secret(served, path):
    status, _, body = ask(served, path, secret=False)
    assert (status, body) == (404, b"not found")


@pytest.mark.parametrize(
    "path",
    [
        "../secret.txt",
        "..%2fsecret.txt",
        "page.html",
        "server.py",
        "frame/0/../secret.txt",
        "frame/0/%2e%2e/secret.txt",
        "frame/-1/1001.png?layer=x&ev=0",
        "frame/2/1001.png?layer=x&ev=0",
        "frame/0/9999.png?layer=x&ev=0",
        "frame/0/x.png?layer=x&ev=0",
        "frame/0/1001.exr?layer=x&ev=0",
        "frame/0/1001.png",
        "frame/0/1001.png?layer=../../secret.txt&ev=0",
        "frame/0/1001.png?layer=ViewLayer.Combined&ev=nan",
        "frame/0/1001.png?layer=ViewLayer.Combined&ev=1e9",
        "frame/0/1001.png?layer=ViewLayer.Combined&ev=x",
        "frame/0/1001.png?layer=ViewLayer.Combined&ev=0&view=x",
        "facts/0/1001.txt",
        "values/0/1001.json",
        "values/0/1001.json?layer=ViewLayer.Combined&x=a&y=0",
        "values/0/1001.json?layer=../secret.txt&x=0&y=0",
        "facts/9/1001.json",
        "frame",
        "a/b/c/d/e",
    ],
)
def test_what_is_no_picture_of_the_sequences_is_not_found(served, path):
    status, _, body = ask(served, path)
    assert status == 404
    assert b"secret" not in body.replace(b"secret.txt", b"")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_nothing_can_be_sent(served, method):
    assert ask(served, "state", method=method)[0] == 501


def test_it_listens_on_this_machine_alone(served):
    assert served.server_address[0] == "127.0.0.1"
    try:
        found = socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
    except socket.gaierror:
        pytest.skip("the machine's own name has no address here, as under Wine")
    addresses = {info[4][0] for info in found}
    for address in addresses - {"127.0.0.1", "127.0.1.1"}:
        with pytest.raises(ConnectionRefusedError), socket.create_connection((address, served.port), timeout=2):
            pass


def test_a_frame_that_is_not_whole_is_a_conflict_and_can_be_asked_for_again(served):
    path = Path(served.sequences[0].spec) / "shot.1003.exr"
    whole = (path.parent / "shot.1002.exr").read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    status, _, body = ask(served, f"frame/0/1003.png?layer={COMBINED}&ev=0")
    assert status == 409
    assert b"damaged or truncated" in body
    assert ask(served, "state")[0] == 200
    path.write_bytes(whole)
    assert ask(served, f"frame/0/1003.png?layer={COMBINED}&ev=0")[0] == 200


def test_many_are_answered_at_once(served):
    paths = [f"frame/{s}/{n}.png?layer={COMBINED}&ev={ev}" for s in (0, 1) for n in (1001, 1002) for ev in range(-8, 0)]
    with ThreadPoolExecutor(16) as pool:
        answers = list(pool.map(lambda path: ask(served, path), paths))
    assert {status for status, _, _ in answers} == {200}
    assert len({body for _, _, body in answers}) == len(paths)


def test_a_port_that_is_taken_is_an_error(served):
    with pytest.raises(OSError, match=r"[Aa]ddress|WinError 100(48|13)"):  # in use; another's alone
        ViewServer(served.sequences, port=served.port)
