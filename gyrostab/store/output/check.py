"""The decision whether a path may be written, shared by every command and function that writes."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from gyrostab.errors import OptionError, OutputError
from gyrostab.store.output.content import FindForeign, find_foreign_item, is_store
from gyrostab.store.output.inputs import match_files, protected_inputs
from gyrostab.store.remote import find_remote_kind, find_url

_MAX_LINKS = 40  # limit of Linux (path_resolution(7)); more links are treated as a loop


def resolve_link(path: str | os.PathLike[str]) -> Path:
    """Follow the symbolic links at the end of a path: the target is replaced, not the link.

    Raises
    ------
    OutputError
        When the links form a loop.
    """
    target = Path(path)
    if target.name in ("", ".."):
        target = Path(os.path.abspath(target))
    for _ in range(_MAX_LINKS):
        if not target.is_symlink():
            return target
        target = target.parent / os.readlink(target)
    raise OutputError(
        f"output {str(path)!r} is a symbolic link in a loop; give another name with -o"
    )


def check_output(
    path: str | os.PathLike[str],
    *,
    suffixes: Sequence[str] = (),
    overwrite: bool = False,
    find_foreign: FindForeign | None = None,
) -> Path:
    """Check, before the computation starts, that a result can be written and nothing else is lost.

    A symbolic link means its target. An existing output is replaced only with `overwrite`, and a
    folder only if all of its content was made by gyrostab or belongs to a Zarr store.

    Parameters
    ----------
    suffixes : sequence of str
        Allowed suffixes, with the dot; empty for any.
    overwrite : bool
        Whether an existing output may be replaced.
    find_foreign : callable, optional
        Function that finds an item that must not be removed; the output is a folder then. By
        default the output is a Zarr store if its name ends in ``.zarr``, else a file.

    Raises
    ------
    OptionError
        When the path has a wrong suffix, is an input, contains an input or is inside one.
    OutputError
        When the output exists and may not be replaced, or its folder cannot be written to.

    Examples
    --------
    >>> check_output("product.txt", suffixes=[".nc"])
    Traceback (most recent call last):
    gyrostab.errors.OptionError: output 'product.txt' must end in .nc; give another name with -o
    """
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise OptionError(
            f"output {str(path)!r} must end in {' or '.join(suffixes)}; give another name with -o"
        )
    if find_foreign is None and path.suffix.lower() == ".zarr":
        find_foreign = find_foreign_item
    target = check_target(path, overwrite=overwrite, find_foreign=find_foreign)
    if not find_url(path):
        _check_writable(path, target.parent)
    return path


def check_folder(
    folder: str | os.PathLike[str], names: Iterable[str], *, overwrite: bool = False
) -> Path:
    """Check that files can be written to a folder, which may hold others or not exist yet.

    Raises
    ------
    OptionError, OutputError
        As for `check_output`, for any of the files.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"output {str(folder)!r} is a file; give the name of a folder with -o")
    present = [name for name in names if os.path.lexists(folder / name)]
    if present and not overwrite:
        raise OutputError(
            f"output {str(folder)!r} holds {', '.join(sorted(present))} already; "
            "give --overwrite to replace, or another folder with -o"
        )
    for name in present:
        check_target(folder / name, overwrite=overwrite)
    above = folder
    while not above.exists() and above != above.parent:
        above = above.parent
    _check_writable(folder, above)
    return folder


def check_target(
    path: Path,
    *,
    overwrite: bool,
    inputs: Iterable[str | os.PathLike[str]] = (),
    find_foreign: FindForeign | None = None,
) -> Path:
    """Do what `check_output` does, without a test write; return the target of the path.

    `inputs` are files that a lazy dataset reads, in addition to those of
    `gyrostab.store.output.protect_inputs`.
    """
    url = find_url(path)
    if url is not None:
        _check_address(url, store=find_foreign is not None)
        return path
    label = f"output {str(path)!r}"
    target = resolve_link(path)
    if not target.parent.is_dir():
        raise OutputError(
            f"{label}: there is no directory {str(target.parent)!r}; "
            "make it first or choose another name with -o"
        )
    _check_inputs(label, target, protected_inputs(), "give another name with -o")
    _check_inputs(
        label,
        target,
        match_files(inputs),
        "load the dataset first, with its load(), or give another name",
    )
    try:
        mode = os.lstat(target).st_mode
    except FileNotFoundError:
        return target
    except OSError as error:
        raise OutputError(
            f"{label} cannot be written ({error.strerror}); give another name with -o"
        ) from error
    if find_foreign is None:
        if stat.S_ISDIR(mode):
            raise OutputError(f"{label} is a directory; give another name with -o")
        if not stat.S_ISREG(mode):
            raise OutputError(
                f"{label} is not a regular file and is not replaced; give another name with -o"
            )
    elif not stat.S_ISDIR(mode):
        raise OutputError(
            f"{label} is a file, and a folder is to be written; give another name with -o"
        )
    elif (foreign := _find_foreign(label, target, find_foreign)) is not None:
        raise OutputError(
            f"{label} holds {foreign!r}, which gyrostab did not make, "
            "so it is not replaced, not even with --overwrite; give another name with -o"
        )
    if not overwrite:
        raise OutputError(
            f"{label} exists already; "
            "give --overwrite (overwrite=True) to replace it, or another name with -o"
        )
    return target


def _check_address(url: str, *, store: bool) -> None:
    """Check that nothing is at an address; what is there is never replaced."""
    if not store:
        raise OutputError(
            f"output {url!r}: only a Zarr store (.zarr) is written to an address; give another "
            "name with -o, and copy the file there"
        )
    if find_remote_kind(url, required=False, error=OutputError) in ("store", "file"):
        raise OutputError(
            f"output {url!r} exists already, and nothing at an address is replaced; remove it "
            "first, or give another name with -o"
        )


def _find_foreign(label: str, target: Path, find_foreign: FindForeign) -> str | None:
    try:
        return find_foreign(target)
    except OSError as error:
        raise OutputError(
            f"{label}: its content cannot be listed ({error.strerror}); give another name with -o"
        ) from error


def _check_inputs(label: str, target: Path, inputs: Sequence[Path], advice: str) -> None:
    """Compare by identity, which does not depend on links and other spellings of a path."""
    target_status, place = _find_status(target), _find_real_path(target)
    folder = target_status is not None and stat.S_ISDIR(target_status.st_mode)
    for item in inputs:
        status = _find_status(item)
        if status is None:
            continue
        if target_status is not None and os.path.samestat(target_status, status):
            raise OptionError(f"{label} is also an input and would be destroyed; {advice}")
        if folder and _find_real_path(item).startswith(os.path.join(place, "")):
            raise OptionError(
                f"{label} is a folder around the input {str(item)!r}, "
                f"which would be destroyed; {advice}"
            )
        inside = stat.S_ISDIR(status.st_mode) and place.startswith(
            os.path.join(_find_real_path(item), "")
        )
        if inside and is_store(item):
            raise OptionError(
                f"{label} lies inside the input {str(item)!r}, which would be changed; {advice}"
            )


def _find_real_path(path: Path) -> str:
    """Resolve links; on Windows, also ignore the case of letters."""
    return os.path.normcase(os.path.realpath(path))


def _find_status(path: Path) -> os.stat_result | None:
    """Find the status of the target of a path; None when it does not exist."""
    try:
        return path.stat()
    except OSError:
        return None


def _check_writable(path: Path, folder: Path) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OutputError(
            f"output {str(path)!r}: nothing can be written in {str(folder)!r} ({error.strerror})"
        ) from error
