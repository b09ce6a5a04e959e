from __future__ import annotations

import io
import os
import stat
import zipfile
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from wholearm.common import files as archive
from wholearm.common.errors import InputError
from wholearm.common.files import read_arrays, write_whole


def fail_halfway(stream: BinaryIO) -> None:
    stream.write(b"half")
    raise RuntimeError("stopped")


def test_writes_the_whole_file_and_nothing_else(tmp_path: Path) -> None:
    write_whole(tmp_path / "out.txt", lambda stream: stream.write(b"content"))
    assert [path.name for path in tmp_path.iterdir()] == ["out.txt"]
    assert (tmp_path / "out.txt").read_bytes() == b"content"


def test_old_file_survives_a_failed_writer(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="stopped"):
        write_whole(target, fail_halfway)
    assert target.read_bytes() == b"old" and list(tmp_path.iterdir()) == [target]


def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    def write(stream: BinaryIO) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match="cannot be written: No space left") as caught:
        write_whole(tmp_path / "out.txt", write)
    assert caught.value.source == str(tmp_path / "out.txt")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("mask, bits", [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_permissions_follow_the_umask(tmp_path: Path, mask: int, bits: int) -> None:
    before = os.umask(mask)
    try:
        write_whole(tmp_path / "out.txt", lambda stream: stream.write(b"x"))
        assert os.umask(mask) == mask
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out.txt").stat().st_mode) == bits


@pytest.mark.parametrize("name", ["absent/out.txt", "", "file.txt/out.txt"])
def test_place_that_cannot_be_written(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.txt").write_bytes(b"")
    with pytest.raises(InputError, match="cannot be written") as caught:
        write_whole(tmp_path / name, lambda stream: stream.write(b"x"))
    assert caught.value.source == str(tmp_path / name) and caught.value.exit_status == 2
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]


def test_a_link_keeps_pointing_to_its_file(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_bytes(b"old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_whole(tmp_path / "link.txt", lambda stream: stream.write(b"new"))
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_bytes() == b"new"


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(pipe, lambda stream: stream.write(b"through"))
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode) and list(tmp_path.iterdir()) == [pipe]


def _write(path: Path, members: dict[str, bytes]) -> str:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return str(path)


def _header(shape: str, kind: str) -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(24)


def test_only_what_is_asked_for_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, t=np.arange(3.0), other=np.ones(2))
    arrays = read_arrays(path, ("t", "q"))
    assert list(arrays) == ["t"]
    np.testing.assert_array_equal(arrays["t"], np.arange(3.0))


@pytest.mark.parametrize(
    ("shape", "kind"), [("(1000000000000,)", "<f8"), ("(3,)", "<U1000000"), ("(4,)", "<f8")]
)
def test_an_array_has_to_hold_what_it_claims(tmp_path: Path, shape: str, kind: str) -> None:
    path = _write(tmp_path / "a.npz", {"t": _header(shape, kind)})
    with pytest.raises(InputError, match=r"a\.npz: t: claims \d+ bytes of .* and holds 24"):
        read_arrays(path, ("t",))


def test_objects_are_not_unpickled(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.array([{}], dtype=object), allow_pickle=True)
    path = _write(tmp_path / "a.npz", {"t": stream.getvalue()})
    with pytest.raises(InputError, match="Python objects"):
        read_arrays(path, ("t",))


def test_a_member_that_is_too_large_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _write(tmp_path / "a.npz", {"t": bytes(2**18 + 1)})
    monkeypatch.setattr(archive, "LARGEST", 2**18)
    with pytest.raises(InputError, match="262145 bytes; allowed are up to 262144"):
        read_arrays(path, ("t",))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x93NUMPY\x01\x00", b"t,tau1,tau2"])
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="is not a trajectory file"):
        read_arrays(path, ("t",))
