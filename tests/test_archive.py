from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from wholearm.common import files as archive
from wholearm.common.errors import InputError
from wholearm.common.files import read_arrays


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
