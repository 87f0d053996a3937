"""Settings of the simulator from a TOML file and from options."""

import tomllib
from pathlib import Path
from typing import Any

import msgspec

from hcnaf_export.data.sim import SimSettings
from hcnaf_runtime.errors import InputError

SPLITS = ("train", "val", "test")


def sim_settings(path: Path | None, options: dict[str, Any]) -> SimSettings:
    """The file's settings (the defaults if None), overridden by the options that were given.

    Raises InputError for a missing file, a file that is not TOML, or an unknown or impossible setting.
    """
    plain: dict[str, Any] = _read(path) if path else {}
    for name in ("seed", "seconds", "jobs"):
        if options.get(name) is not None:
            plain[name] = options[name]
    for name in ("windows", "networks"):
        if options.get(name) is not None:
            plain |= {f"{split}_{name}": n for split, n in zip(SPLITS, options[name], strict=True)}
    for split in SPLITS:
        if options.get(f"{split}_nets"):
            plain[f"{split}_nets"] = [str(net) for net in options[f"{split}_nets"]]
    try:
        return msgspec.convert(plain, SimSettings)
    except msgspec.ValidationError as e:
        raise InputError(f"{path or 'simulator'}: {e}; mend the setting") from e


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e}); expected settings as TOML") from e
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise InputError(f"{path}: not TOML ({e}); expected settings of the simulator") from e
