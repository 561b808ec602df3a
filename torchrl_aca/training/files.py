"""Files that are replaced whole or not at all, and checked when they are read."""

from __future__ import annotations

import csv
import io
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import torch


def replace_file(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Writes a file under a temporary name and renames it when it is complete.

    A crash, a kill or a full disk in between leaves what stood there before; a kill the temporary
    file as well.

    Raises:
        OSError: If the disk is full or broken.
    """
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with open(temporary, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, RuntimeError):  # torch's own of a full disk
            raise OSError(f"{path}: {error}") from error
        raise


def write_text(path: Path, text: str) -> None:
    """Replaces the text of a file, as `replace_file` does."""
    replace_file(path, lambda file: file.write(text.encode()))


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Replaces a table, as `replace_file` does; what rows have besides the columns is left out."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def read_csv(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Reads the columns and rows of a table that grows by whole lines.

    What stands behind the last line's end is half a row, which a killed process has left.
    """
    with open(path, newline="") as file:
        lines = [line for line in file if line.endswith("\n")]
    reader = csv.DictReader(lines)
    return list(reader.fieldnames or []), list(reader)


def read_torch_file(
    path: Path, file_format: str, entries: Mapping[str, type]
) -> tuple[dict[str, Any], str]:
    """Reads what `torch.save` has written: tensors, numbers, texts and containers of them, no code.

    Args:
        path: The file.
        file_format: What its entry "format" has to be.
        entries: Other entries that it must have, and their types; "a.b" is b in a.

    Returns:
        The content, and what is wrong with it: nothing where it can be used.
    """
    try:
        with zipfile.ZipFile(path) as file:  # torch.save writes a checksum of every record
            if (record := file.testzip()) is not None:
                return {}, f"is damaged: the checksum of its {record!r} does not fit"
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what unpickling raises depends on the foreign bytes
        return {}, f"cannot be read ({type(error).__name__}): damaged or foreign"
    found = content.get("format") if isinstance(content, dict) else type(content).__name__
    if found != file_format:
        return {}, f"is not of this version: expected {file_format!r}, got {found!r}"
    for name, kind in entries.items():
        value: Any = content
        for key in name.split("."):
            value = value.get(key)
        if not isinstance(value, kind):
            last = name.rpartition(".")[2]
            return {}, f"has no {last}: expected a {kind.__name__}, got {type(value).__name__}"
    return content, ""
