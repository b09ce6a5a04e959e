"""Trajectory files with something wrong in them, from a seeded generator."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from .trees import change_tree, pick

METAS = (
    "{" * 5000, "[" * 100_000, '{"problem": {}}', '{"rolling": [[]]}', "NaN", '{"epsilon": NaN}',
)  # fmt: skip
"""Texts that take the place of a trajectory's `meta`."""

_DEFLATED = (zipfile.ZIP_DEFLATED,)


def mutate_archive(rng: np.random.Generator, base: bytes) -> tuple[str, bytes]:
    """A trajectory file with one array, its `meta` or the archive itself changed; says what."""
    with np.load(io.BytesIO(base)) as data:
        arrays: dict[str, Any] = {name: data[name] for name in data.files}
    how = str(rng.choice(["array", "array", "array", "meta", "meta", "header", "archive"]))
    if how == "meta":
        what, text = _mutate_meta(rng, str(arrays["meta"]))
        arrays["meta"] = np.array(text)
        return what, pack(arrays)
    if how == "array":
        name = pick(rng, list(arrays))
        what, changed = _mutate_array(rng, arrays[name])
        if changed is None:
            arrays[pick(rng, ["x", "T", "tau"])] = arrays.pop(name)
            if what == "delete":
                arrays.popitem()
        else:
            arrays[name] = changed
        return f"{what} {name}", pack(arrays)
    if how == "header":
        name = pick(rng, list(arrays))
        shape = pick(rng, [(10**12,), (10**6, 10**6), (2**62, 4), (-1,), (10**9, 3), (3, 2**40)])
        kind = pick(rng, ["<f8", "<i8", "<U1000000", "|O", "<f4", ">f8", "|V1000000000", "<M8[s]"])
        header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
        raw = (
            b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + b"\0" * 64
        )
        return f"{name} claims {shape} of {kind}", pack(arrays, {name: raw})
    what = pick(rng, ["plain", "text", "nested", "twice", "folder", "deflated", "name"])
    if what == "plain":
        stream = io.BytesIO()
        np.save(stream, arrays["t"])
        return "a plain array", stream.getvalue()
    if what == "text":
        return "text", b"t,tau1,tau2\n0,0,0\n1,0,0\n"
    extra = {"nested": "a/b/t", "twice": "t", "folder": "t/", "name": "../t", "deflated": "x"}[what]
    return f"archive with {extra}", pack(arrays, {extra: b"" if what == "folder" else b"abc"}, True)


def pack(arrays: dict[str, Any], raw: dict[str, bytes] | None = None, add: bool = False) -> bytes:
    """The arrays as an archive, some members with bytes of their own."""
    import warnings

    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")
        for name, array in arrays.items():
            if raw and name in raw and not add:
                continue
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=True)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getvalue(), *_DEFLATED)
        for name, content in (raw or {}).items():
            full = name if name.endswith("/") else f"{name}.npy"
            archive.writestr(zipfile.ZipInfo(full), content, *_DEFLATED)
    return stream.getvalue()


def _mutate_array(rng: np.random.Generator, array: Any) -> tuple[str, Any]:
    how = str(rng.choice(["delete", "rename", "value", "value", "value", "type", "shape", "order"]))
    if how in ("delete", "rename"):
        return how, None
    number = array.dtype.kind in "iuf"
    if how == "value" and number and array.size:
        new = pick(rng, [np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, -1.0, 1e30, 1e-30, 7.0])
        changed = (
            array.astype(float) if rng.uniform() < 0.8 or not np.isfinite(new) else array.copy()
        )
        count = pick(rng, [1, 1, max(1, array.size // 10), array.size])
        where = rng.integers(array.size, size=count)
        with np.errstate(all="ignore"):
            changed.flat[where] = new if changed.dtype.kind == "f" else int(np.sign(new))
        return f"{new} in", changed
    if how == "order" and array.ndim:
        return "reversed", array[::-1] if rng.uniform() < 0.5 else rng.permutation(array)
    if how == "type":
        kinds: list[Callable[[], Any]] = [
            lambda: array.astype(str), lambda: array.astype(object), lambda: array.astype("S8"),
            lambda: np.zeros(array.shape, complex), lambda: np.zeros(array.shape, bool),
            lambda: np.zeros(array.shape, "M8[s]"), lambda: np.zeros(array.shape, "f2"),
            lambda: np.zeros(array.shape, [("a", "f8")]), lambda: np.zeros(array.shape, ">f8"),
            lambda: np.zeros(array.shape, np.longdouble), lambda: np.zeros(array.shape, "u1"),
            lambda: np.array({"a": 1}, dtype=object), lambda: np.array("text"),
        ]  # fmt: skip
        made = pick(rng, kinds)()
        return f"{made.dtype.str} for", made
    shapes: list[Callable[[], Any]] = [
        lambda: array[:1], lambda: array[:-1], lambda: array[:0], lambda: array[None],
        lambda: array[..., None], lambda: array.T, lambda: array.ravel(),
        lambda: np.concatenate([array, array]), lambda: array.ravel()[0] if array.size else array,
        lambda: np.repeat(array, 3, axis=-1), lambda: np.zeros((0, 0)), lambda: np.zeros(()),
    ]  # fmt: skip
    if not array.ndim:
        return "more than one", np.array([array, array])
    return "another shape of", pick(rng, shapes)()


def _mutate_meta(rng: np.random.Generator, text: str) -> tuple[str, str]:
    how = str(rng.choice(["tree", "tree", "tree", "tree", "text"]))
    if how == "tree":
        meta = json.loads(text)
        done = change_tree(rng, meta)
        try:
            return f"meta: {done}", json.dumps(meta)
        except (TypeError, ValueError):
            return "meta: empty", "{}"
    texts = ("", "null", "[]", "{}", "1", '"text"', text[: len(text) // 2], text + "}", *METAS)
    new = pick(rng, texts)
    return f"meta is {new[:20]!r} of {len(new)}", new
