"""The server of the authoring page when the page is closed, or a connection stays silent."""

from __future__ import annotations

import json
import socket
import threading
import time

import pytest

from characterisation.files.errors import InputError
from mitsim.report import author_server
from mitsim.report.author_server import AuthorServer

TASK = '[features.top]\nkind = "plane"\npoint_mm = [0, 0, 0]\ndirection = [0, 0, 1]\n'


@pytest.fixture
def closed(tmp_path):
    """A server whose check is still running when the page has been closed, its thread, and what its thread printed."""
    gone = threading.Event()

    def check():
        assert gone.wait(20)
        return [{"severity": "note", "about": "", "what": "x" * 10_000_000, "advice": ""}]

    names = {"scene": "part.xml", "task": "task.toml", "study": "study.toml"}
    server = AuthorServer(tmp_path, names, lambda token: token, check)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    return server, thread, gone


def post(server, what, sent):
    body = json.dumps(sent).encode()
    head = (
        f"POST /{server.token}/{what} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=20)
    connection.sendall(head.encode() + body)
    return connection


def test_the_command_ends_if_the_page_closes_while_it_saves_and_finishes(closed, tmp_path, capfd):
    server, thread, gone = closed
    post(server, "save", {"files": {"task": TASK}, "done": True}).close()
    gone.set()
    thread.join(20)
    assert not thread.is_alive()
    assert (server.saved, (tmp_path / "task.toml").read_text()) == (1, TASK)
    assert capfd.readouterr().err == ""


def test_a_request_nested_too_deep_is_no_request(closed):
    """Before, a RecursionError."""
    assert closed[0].save(b"[" * 100_000)[0] == 400


def test_the_server_continues_after_a_page_that_closed_while_it_saved(closed, capfd):
    server, thread, gone = closed
    post(server, "save", {"files": {"task": TASK}}).close()
    gone.set()
    with post(server, "done", {}) as connection:
        assert connection.recv(100).startswith(b"HTTP/1.0 200")
    thread.join(20)
    assert not thread.is_alive()
    assert capfd.readouterr().err == ""


def test_files_that_are_refused_do_not_finish(closed):
    server, thread, gone = closed
    gone.set()
    with post(server, "save", {"files": {"task": "kind ="}, "done": True}) as connection:
        assert connection.recv(100).startswith(b"HTTP/1.0 422")
    assert not server.done
    post(server, "done", {}).close()
    thread.join(20)
    assert not thread.is_alive()


def test_a_study_that_was_written_meanwhile_is_kept(tmp_path):
    names = {"task": "task.toml", "study": "study.toml"}
    proposed = 'scene = "a.xml"\ntask = "task.toml"\nsensor = "ensenso-n10"\n[views]\n'
    server, other = AuthorServer(tmp_path, names, lambda token: token, list), proposed + "subdivisions = 2\n"
    sent = json.dumps({"files": {"task": TASK, "study": proposed}}).encode()
    with server._server:
        (tmp_path / "study.toml").write_text(other)
        assert server.save(sent)[1]["written"] == ["task.toml"]
        assert (tmp_path / "study.toml").read_text() == other
        (tmp_path / "study.toml").unlink()
        assert server.save(sent)[1]["written"] == server.save(sent)[1]["written"] == ["study.toml", "task.toml"]


@pytest.mark.parametrize("fault", [RuntimeError, KeyboardInterrupt, MemoryError])
def test_files_are_restored_whatever_ends_their_check(tmp_path, fault):
    def check():
        assert (tmp_path / "task.toml").read_text() == TASK
        raise fault

    (tmp_path / "part.xml").write_text("old")
    server = AuthorServer(tmp_path, {"scene": "part.xml", "task": "task.toml"}, lambda token: token, check)
    with server._server, pytest.raises(fault):
        server.save(json.dumps({"files": {"scene": "new", "task": TASK}}).encode())
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"part.xml": "old"}


def test_a_page_whose_files_were_broken_by_hand_says_so(tmp_path):
    def page(token):
        raise InputError("part.xml", "shape", "no shape at all", "at least one shape")

    server = AuthorServer(tmp_path, {"task": "task.toml"}, page, list)
    thread = threading.Thread(target=server._server.handle_request, daemon=True)
    thread.start()
    with server._server, socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        connection.sendall(f"GET /{server.token}/ HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode())
        answer = connection.makefile("rb").read().decode()
        thread.join(20)
    assert answer.startswith("HTTP/1.0 422") and "no shape at all" in answer


def test_a_silent_connection_does_not_hold_up_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(author_server, "_SECONDS", 0.2)
    server = AuthorServer(tmp_path, {"task": "task.toml"}, lambda token: token, list)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    silent = socket.create_connection(("127.0.0.1", server.port), timeout=20)
    time.sleep(0.05)
    with silent, post(server, "done", {}) as connection:
        assert connection.recv(100).startswith(b"HTTP/1.0 200")
    thread.join(20)
    assert not thread.is_alive()
