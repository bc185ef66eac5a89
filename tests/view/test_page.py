"""Pages without a browser: who gets an answer, addresses that are in use, the missing package."""

import http.client
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.view.page import Page


@pytest.fixture
def page() -> Iterator[Page]:
    served = Page(port=0)
    yield served
    served.close()


@pytest.fixture
def open_page() -> Iterator[Page]:
    """A page that other machines reach."""
    served = Page(host="0.0.0.0", port=0)
    yield served
    served.close()


def get(page: Page, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=20)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def token_of(page: Page) -> str:
    return page.url.partition("?token=")[2]


def test_page_is_served_on_the_loopback_address(page: Page) -> None:
    assert page.url == f"http://127.0.0.1:{page.port}/"
    answer = get(page)
    assert answer.status == 200
    assert b"<!doctype html>" in answer.read().lower()


def test_a_page_for_other_machines_answers_only_with_its_token(open_page: Page) -> None:
    token = token_of(open_page)
    assert len(token) >= 32
    refused: list[tuple[str, dict[str, str]]] = [
        ("/", {}),
        ("/index.html", {}),
        ("/?token=", {}),
        ("/?token=wrong", {}),
        ("/?token=%C3%A9", {}),
        ("/?token=" + token[:-1], {}),
        ("/", {"Cookie": f"gelflow_token_{open_page.port}=wrong"}),
        ("/", {"Cookie": f"gelflow_token={token}"}),
    ]
    for path, headers in refused:
        answer = get(open_page, path, **headers)
        body = answer.read()
        assert answer.status == 403, (path, headers)
        assert body.startswith(b"gelflow: open the address") and token.encode() not in body
    answer = get(open_page, f"/?token={token}")
    assert answer.status == 200
    cookie = answer.headers["Set-Cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert get(open_page, "/", Cookie=cookie.partition(";")[0]).status == 200


def websocket(page: Page, **options: Any) -> None:
    """Connect as the page does and receive a message."""
    import viser

    protocols = [Subprotocol(f"viser-v{viser.__version__}")]
    address = f"ws://127.0.0.1:{page.port}/"
    with connect(address, subprotocols=protocols, proxy=None, open_timeout=20, **options) as socket:
        assert socket.recv(timeout=20)


def test_a_websocket_needs_the_token_too(open_page: Page) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        websocket(open_page)
    cookie = f"gelflow_token_{open_page.port}={token_of(open_page)}"
    websocket(open_page, additional_headers={"Cookie": cookie})


def test_other_sites_get_no_answer(page: Page) -> None:
    websocket(page)
    with pytest.raises(InvalidStatus, match="403"):
        websocket(page, origin="http://evil.example")
    assert get(page, Host="evil.example").status == 403
    assert get(page, Host=f"127.evil.example:{page.port}").status == 403  # a name, whatever its address is
    assert get(page, Host=f"127.0.0.2:{page.port}").status == 200
    assert get(page, Host=f"localhost:{page.port}").status == 200


def test_malformed_requests_are_refused(page: Page, open_page: Page) -> None:
    for served in (page, open_page):
        assert get(served, Host="[").status == 403
        assert get(served, Origin="http://[").status == 403
        assert get(served, "//[").status == 403
        connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=20)
        connection.putrequest("GET", "/")  # with a host
        connection.putheader("Host", "localhost")
        connection.endheaders()
        assert connection.getresponse().status == 403


def test_two_pages_have_different_tokens() -> None:
    pages = [Page(host="0.0.0.0", port=0) for _ in range(2)]
    assert len({token_of(page) for page in pages}) == 2
    for page in pages:
        page.close()
        page.close()


def test_an_address_in_use_is_refused_in_one_line(page: Page) -> None:
    with pytest.raises(UsageError, match=rf"^port {page.port} of 127\.0\.0\.1 is in use; choose another with --port"):
        Page(port=page.port)
    with pytest.raises(UsageError, match="port must be 0 to 65535"):
        Page(port=70000)
    with pytest.raises(UsageError, match=r"cannot serve a page on no\.such.host.invalid"):
        Page(host="no.such.host.invalid")


def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    page = Page(port=0)
    get(page).read()
    page.close()
    assert capfd.readouterr() == ("", "")


def test_without_viser_the_command_names_the_extra() -> None:
    code = (
        "import sys; sys.modules['viser'] = None\n"
        "from gelflow.cli.main import main\n"
        "sys.exit(main(['view', 'rolling']))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert result.returncode == 2
    assert "pip install 'gelflow[view]'" in result.stderr and result.stderr.count("\n") == 1


def test_command_serves_a_model_file_until_it_is_interrupted(tmp_path: Path) -> None:
    model = tmp_path / "arm.xml"
    model.write_text(
        "<mujoco><worldbody><body><joint type='hinge'/><geom type='box' size='.1 .1 .1'/></body></worldbody></mujoco>"
    )
    command = [sys.executable, "-m", "gelflow.cli", "view", str(model), "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(3)]
        address = urlsplit(json.loads("".join(lines))["url"])
        connection = http.client.HTTPConnection("127.0.0.1", address.port or 0, timeout=20)
        connection.request("GET", "/")
        assert connection.getresponse().status == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
        assert process.stdout.read() == ""


@pytest.mark.parametrize("options", [["--num-envs", "3"], ["--env", "1"], ["--preset", "fast"]])
def test_options_of_scenes_are_refused_for_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    (tmp_path / "run.json").write_text("{}")
    assert main(["view", str(tmp_path), *options, "--port", "0"]) == 2
    error = capsys.readouterr().err
    assert f"{options[0]} is for scenes" in error and error.count("\n") == 1


def test_a_folder_that_is_no_run_does_not_hide_a_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rolling").mkdir()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["view", "rolling", "--env", "7", "--port", "0"]) == 2
    assert "env must be below 1" in capsys.readouterr().err  # of the scene
    assert main(["view", "other", "--port", "0"]) == 2
    assert "gelflow eval --out" in capsys.readouterr().err
