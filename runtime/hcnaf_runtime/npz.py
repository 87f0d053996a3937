"""Reading and writing .npz files that come from somewhere else: bounded, unpickled, atomic.

`numpy.load` allocates what a header claims before anyone can object. Here the headers are read first, every
array is checked against a limit, and only then is memory taken.
"""

import math
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.errors import HcnafError, InputError

Array = npt.NDArray[Any]
Check = Callable[[str, np.dtype[Any], tuple[int, ...]], None]

MAX_BYTES = 1 << 30
MAX_MEMBERS = 256


class _MalformedError(Exception):
    """What is wrong with the file, in words that fit after its name."""


def read_npz(
    path: str | os.PathLike[str], error: type[HcnafError], check: Check | None = None, only: str | None = None
) -> dict[str, Array]:
    """The arrays of the .npz file at `path`, read-only, by name; just the one named `only` if that is given.

    `check(name, dtype, shape)` is called for every array before any of them is allocated and raises `error`
    where it objects. Raises `error` with one line for a missing file, a file that is not an .npz, pickled
    arrays, a truncated archive or more than MAX_BYTES in total.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _read_members(archive, check, only)
    except error as e:
        raise error(f"{path}: {e}") from e
    except FileNotFoundError:
        raise error(f"{path}: no such file; expected an .npz file") from None
    except OSError as e:
        raise error(f"{path}: cannot be read ({e.strerror or e})") from e
    except (_MalformedError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError) as e:
        reason = " ".join(str(e).split()) or type(e).__name__
        raise error(f"{path}: not a readable .npz file ({reason}); write it with numpy.savez") from e


def _read_members(archive: zipfile.ZipFile, check: Check | None, only: str | None) -> dict[str, Array]:
    members = [m for m in archive.infolist() if only is None or _stem(m.filename) == only]
    if len(members) > MAX_MEMBERS:
        raise _MalformedError(f"{len(members)} arrays, at most {MAX_MEMBERS} are read")
    total = 0
    for member in members:
        with archive.open(member) as stream:
            dtype, shape, _ = _header(stream, member.filename)
        if check is not None:
            check(_stem(member.filename), dtype, shape)
        total += _size(dtype, shape)
        if total > MAX_BYTES:
            raise _MalformedError(f"arrays of more than {MAX_BYTES >> 20} MiB in total")
    return {_stem(member.filename): _array(archive, member) for member in members}


def _stem(filename: str) -> str:
    return filename.removesuffix(".npy")


def _size(dtype: np.dtype[Any], shape: tuple[int, ...]) -> int:
    return dtype.itemsize * math.prod(shape)


def _header(stream: IO[bytes], name: str) -> tuple[np.dtype[Any], tuple[int, ...], bool]:
    if not name.endswith(".npy"):
        raise _MalformedError(f"holds '{name}', which is not an array")
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise _MalformedError(f"'{name}' has array format {version}, 1.0 and 2.0 are read")
    if dtype.hasobject:
        raise _MalformedError(f"'{_stem(name)}' holds pickled objects, which are never read")
    if any(extent < 0 for extent in shape):
        raise _MalformedError(f"'{_stem(name)}' has the shape {shape}")
    return dtype, shape, fortran


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Array:
    with archive.open(member) as stream:
        dtype, shape, fortran = _header(stream, member.filename)
        size = _size(dtype, shape)
        data = stream.read(size)
        # Reading past the end makes zipfile compare the checksum.
        if len(data) != size or stream.read(1):
            raise _MalformedError(
                f"'{_stem(member.filename)}' has {len(data)} bytes, its shape {shape} takes {size}"
            )
    if size == 0:
        return _locked(np.zeros(shape, dtype))
    flat = np.frombuffer(data, dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def _locked(array: Array) -> Array:
    array.setflags(write=False)
    return array


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write `arrays` to `path`, compressed. Either the whole file appears or nothing does.

    Raises InputError if `path` cannot be written.
    """
    try:
        with atomic(path) as stream:
            np.savez_compressed(stream, **arrays)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror or e})") from e


@contextmanager
def atomic(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """A binary stream whose content replaces the file at `path` when the block ends without an error."""
    target = Path(path)
    handle, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            yield stream
        _give_ordinary_permissions(temporary)
        os.replace(temporary, target)
    except BaseException:
        os.unlink(temporary)
        raise


def _give_ordinary_permissions(path: str) -> None:
    # mkstemp makes files that only their owner reads. The umask cannot be read without setting it, which is
    # global state, so the usual 0644 it is.
    os.chmod(path, 0o644)
