"""Addresses of object stores, such as ``s3://bucket/log.zarr``, which fsspec opens.

pathlib joins the slashes of an address, ``s3:/bucket/log.zarr``; `find_url` restores it, so that
addresses are paths everywhere else. Credentials and endpoints come from the environment, as the
library of each store reads them.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import tempfile
from collections.abc import Iterator
from contextvars import ContextVar
from functools import cache
from pathlib import Path, PurePath
from typing import Any, Literal

from gyrostab.errors import FormatError, GyrostabError, OptionError, OutputError

_URL = re.compile(r"([a-z][a-z0-9+.-]+):/+(.+)")  # a single letter is a drive of Windows
#: Scheme -> the extra that installs its library.
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs", "http": "http", "https": "http"}
#: Names without which a store cannot be opened; they are uploaded last.
ROOT_METADATA = (".zgroup", ".zattrs", ".zmetadata", "zarr.json")
#: What libraries call size, time of change and checksum of an object.
_CHANGES = {
    "size", "ETag", "etag", "md5Hash", "content_md5", "Content-MD5", "LastModified",
    "Last-Modified", "last_modified", "updated", "mtime", "created",
}  # fmt: skip


def find_url(path: str | os.PathLike[str]) -> str | None:
    """Find the address that a path is; None for a local path.

    Examples
    --------
    >>> find_url(Path("s3://bucket/log.zarr")), find_url(Path("C:/log.zarr"))
    ('s3://bucket/log.zarr', None)
    """
    text = path.as_posix() if isinstance(path, PurePath) else os.fspath(path)
    match = _URL.fullmatch(text)
    return None if match is None else f"{match[1]}://{match[2]}"


def given_name(path: str | os.PathLike[str]) -> str:
    """Return the address that a path is, or the local path as it can be given to a command.

    Examples
    --------
    >>> given_name(Path("s3://bucket/log.zarr")), given_name(Path("log.csv"))
    ('s3://bucket/log.zarr', 'log.csv')
    >>> given_name(Path("./-2.csv"))  # which pathlib makes -2.csv
    './-2.csv'
    """
    name = find_url(path) or os.fspath(path)
    return os.path.join(".", name) if name.startswith("-") else name


def full_name(path: str | os.PathLike[str]) -> str:
    """Return the address that a path is, or the absolute local path.

    Examples
    --------
    >>> full_name("s3://bucket/log.zarr")
    's3://bucket/log.zarr'
    """
    return find_url(path) or os.path.abspath(path)


@contextlib.contextmanager
def reaching(url: str, *, error: type[GyrostabError] = FormatError) -> Iterator[None]:
    """Convert exceptions of the library of a store to one `GyrostabError` that names the address.

    Parameters
    ----------
    url : str
        The address.
    error : type
        Exception to raise; `OptionError` if a library is missing or the scheme is not known.
    """
    scheme = url.partition(":")[0]
    try:
        yield
    except GyrostabError:
        raise
    except ImportError as problem:
        extra = _EXTRAS.get(scheme)
        advice = f"pip install 'gyrostab[{extra}]'" if extra else f"install it ({problem})"
        raise OptionError(f"{url}: the library for {scheme}:// is missing; {advice}") from problem
    except Exception as problem:  # libraries raise exceptions of many kinds
        raise error(f"{url}: {_describe_problem(scheme, problem)}") from problem


def _describe_problem(scheme: str, problem: Exception) -> str:
    text = " ".join(str(problem).split()) or type(problem).__name__
    if isinstance(problem, ValueError) and "rotocol not known" in text:
        return f"{scheme}:// is not known; give a local path, s3://, gs:// or https://"
    if isinstance(problem, FileNotFoundError):
        return "there is no such object; check the bucket and the name"
    if isinstance(problem, PermissionError) or "redentials" in f"{type(problem).__name__} {text}":
        return (
            f"access was refused, or no credentials were found ({text}); set those of the store in "
            "the environment, such as AWS_PROFILE, or for a public bucket "
            f"FSSPEC_{scheme.upper()}='{{\"anon\": true}}'"
        )
    return f"the store cannot be reached ({text}); check the address and the network"


@contextlib.contextmanager
def _open_filesystem(
    url: str, *, error: type[GyrostabError] = FormatError
) -> Iterator[tuple[Any, str]]:
    """Provide the file system and the path of an address; exceptions are those of `reaching`."""
    with reaching(url, error=error):
        import fsspec

        filesystem, path = fsspec.core.url_to_fs(url)
        yield filesystem, str(path).rstrip("/")


def find_remote_kind(
    url: str, *, required: bool = True, error: type[GyrostabError] = FormatError
) -> Literal["store", "folder", "file"] | None:
    """Find what is at an address: a Zarr store, another folder, a file, or nothing.

    Raises
    ------
    GyrostabError
        Of the type `error`, when there is nothing although it is `required`, or the address cannot
        be reached.
    OptionError
        When the library for it is missing.
    """
    with _open_filesystem(url, error=error) as (filesystem, path):
        if not required:  # which concerns an output: an earlier listing may have changed
            filesystem.invalidate_cache()
        if any(filesystem.exists(f"{path}/{name}") for name in ROOT_METADATA):
            return "store"
        if filesystem.exists(path):
            return "folder" if filesystem.isdir(path) else "file"
        if required:
            raise FileNotFoundError(url)
    return None


def exists(path: str | Path) -> bool:
    """Whether there is something under a name or address."""
    url = find_url(path)
    if url is None:
        return os.path.exists(path)
    with _open_filesystem(url) as (filesystem, place):
        return bool(filesystem.exists(place))


def read_bytes(path: str | Path, count: int | None = None) -> bytes:
    """Read a file or object, or its first `count` bytes; `OSError` when there is none."""
    url = find_url(path)
    if url is None:
        with open(path, "rb") as file:
            return file.read(-1 if count is None else count)
    with _open_filesystem(url) as (filesystem, path), contextlib.suppress(FileNotFoundError):
        content = filesystem.cat_file(path, end=count)
        return bytes(content)
    raise FileNotFoundError(url)


def list_urls(url: str) -> list[str]:
    """List the addresses that match a pattern."""
    with _open_filesystem(url) as (filesystem, path):
        return [filesystem.unstrip_protocol(name) for name in sorted(filesystem.glob(path))]


def walk_address(url: str) -> Iterator[tuple[str, list[str], list[str]]]:
    """Walk the folders at an address, as `os.walk` does."""
    with _open_filesystem(url) as (filesystem, path):
        filesystem.invalidate_cache()
        for place, folders, files in filesystem.walk(path):
            yield filesystem.unstrip_protocol(place), folders, files


def describe_address(url: str) -> dict[str, Any]:
    """Describe a file, or a Zarr store by its metadata: size [bytes], and a digest of its state.

    The digest changes when the object is replaced: it is made from the size, time of change and
    checksum that the store knows. Both are None where nothing can be reached.
    """
    infos = []
    try:
        with _open_filesystem(url) as (filesystem, path):
            filesystem.invalidate_cache(path)
            names = [path, *(f"{path}/{name}" for name in ROOT_METADATA)]
            for name in names[1:] if filesystem.isdir(path) else names[:1]:
                with contextlib.suppress(FileNotFoundError):
                    infos.append(filesystem.info(name))
    except Exception:  # libraries raise exceptions of many kinds; reading says what is wrong
        return {"bytes": None, "changed_ns": None}
    states = [sorted((key, str(info[key])) for key in _CHANGES & set(info)) for info in infos]
    return {
        "bytes": sum(int(info.get("size") or 0) for info in infos),
        "changed_ns": 0,
        "listing": hashlib.sha256(repr(states).encode()).hexdigest(),
    }


def fetch_file(url: str) -> Path:
    """Download a file to a temporary copy of the same name, again only after it has changed."""
    with _open_filesystem(url) as (filesystem, path):
        filesystem.invalidate_cache(path)
        info = filesystem.info(path)
        if info["type"] == "directory":
            raise FormatError(f"{url}: is a folder, not a Zarr store; name the files in it")
        state = hashlib.sha256(f"{url} {info!r}".encode()).hexdigest()
        copies = _COPIES.get() or _make_folder_of_process().name
        target = Path(copies, state, path.rpartition("/")[2])
        if not target.exists():
            part = Path(tempfile.mkdtemp(dir=copies), target.name)  # another thread may do the same
            filesystem.get_file(path, str(part))
            target.parent.mkdir(exist_ok=True)
            os.replace(part, target)
        return target


#: Folder of downloaded files in a block of `remove_copies`.
_COPIES: ContextVar[str | None] = ContextVar("_COPIES", default=None)


@cache
def _make_folder_of_process() -> tempfile.TemporaryDirectory[str]:
    """Make the folder of other downloaded files, which is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="gyrostab-")


@contextlib.contextmanager
def remove_copies() -> Iterator[None]:
    """Remove the copies of files that this thread downloads in the block, at its end."""
    with tempfile.TemporaryDirectory(prefix="gyrostab-") as folder:
        token = _COPIES.set(folder)
        try:
            yield
        finally:
            _COPIES.reset(token)


def remove_address(url: str) -> None:
    """Remove all that is at an address, if there is something."""
    with _open_filesystem(url, error=OutputError) as (filesystem, path):
        filesystem.invalidate_cache()
        with contextlib.suppress(FileNotFoundError):
            filesystem.rm(path, recursive=True)
        filesystem.invalidate_cache()


@contextlib.contextmanager
def upload_file(path: Path) -> Iterator[Path]:
    """Provide the name to write a file to: a local one, which is uploaded if `path` is an address.

    An object at the address is replaced at once.
    """
    url = find_url(path)
    if url is None:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="gyrostab-") as folder:
        local = Path(folder, path.name)
        yield local
        with _open_filesystem(url, error=OutputError) as (filesystem, place):
            filesystem.put_file(str(local), place)


@contextlib.contextmanager
def upload(url: str) -> Iterator[Path]:
    """Provide a local folder, and upload the Zarr store written there if the block succeeds.

    The metadata without which a store cannot be opened come last.
    """
    with tempfile.TemporaryDirectory(prefix="gyrostab-") as folder:
        yield Path(folder)
        names = [item.relative_to(folder) for item in Path(folder).rglob("*") if item.is_file()]
        with _open_filesystem(url, error=OutputError) as (filesystem, path):
            for is_last in (False, True):
                chosen = [n for n in names if (n.as_posix() in ROOT_METADATA) == is_last]
                filesystem.put(
                    [str(Path(folder, name)) for name in chosen],
                    [f"{path}/{name.as_posix()}" for name in chosen],
                )
