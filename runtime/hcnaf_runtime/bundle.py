"""A bundle: the directory that ships to a vehicle, checked file by file before anything in it is used."""

import hashlib
import os
import threading
from pathlib import Path

from hcnaf_runtime import manifest as manifests
from hcnaf_runtime.errors import BundleError
from hcnaf_runtime.manifest import GraphName, Manifest
from hcnaf_runtime.session import Session, Settings, default_threads

EMBEDDED = Path(__file__).parent / "embedded"
"""The model and the sample scenes that come with the package."""


class Bundle:
    """An opened bundle: `path`, `manifest` and the graphs, loaded when first asked for.

    Opening compares every file the manifest names with its sha256. Sessions are shared between threads and
    live as long as the bundle.
    """

    def __init__(self, path: Path, manifest: Manifest) -> None:
        self.path = path
        self.manifest = manifest
        self._sessions: dict[tuple[str, Settings], Session] = {}
        self._lock = threading.Lock()

    @classmethod
    def open(cls, path: str | os.PathLike[str] | None = None) -> "Bundle":
        """The bundle in the directory `path`, or the embedded one.

        Raises BundleError for a missing or altered file, a malformed manifest or a format not read here.
        """
        if path is None and not (EMBEDDED / "model").is_dir():
            raise BundleError("this installation has no embedded model; name a bundle directory")
        folder = EMBEDDED / "model" if path is None else Path(path).absolute()
        if not folder.is_dir():
            raise BundleError(f"{folder}: no such directory; expected a bundle written by `hcnaf export`")
        manifest = manifests.read(folder / manifests.FILE)
        for name, expected in manifest.files.items():
            _check_file(folder / name, expected)
        return cls(folder, manifest)

    def session(self, name: GraphName, settings: Settings | int | None = None) -> Session:
        """The graph `name`, loaded on first use; `settings` may be just a number of threads.

        Raises BundleError if the bundle has none of that name.
        """
        contract = self.manifest.graphs.get(name)
        if contract is None:
            have = ", ".join(sorted(self.manifest.graphs))
            raise BundleError(f"{self.path}: no graph '{name}', found {have}; maps need a flow of D = 2")
        if not isinstance(settings, Settings):
            settings = Settings(settings or default_threads())
        key = (name, settings)
        with self._lock:
            if key not in self._sessions:
                file = self.path / contract.file
                self._sessions[key] = Session(file, contract, settings, self.manifest.onnxruntime_min)
            return self._sessions[key]


def embedded_scenes() -> dict[str, Path]:
    """The sample scenes that come with the package, by name; empty if there are none."""
    return {path.stem: path for path in sorted((EMBEDDED / "scenes").glob("*.npz"))}


def _check_file(path: Path, expected: manifests.File) -> None:
    try:
        with path.open("rb") as stream:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
    except FileNotFoundError:
        raise BundleError(f"{path}: missing, but named in {manifests.FILE}; copy the bundle again") from None
    except OSError as e:
        raise BundleError(f"{path}: cannot be read ({e.strerror or e})") from e
    if found != expected.sha256:
        raise BundleError(
            f"{path}: altered: sha256 {found[:9]}... found, {expected.sha256[:9]}... expected; copy it again"
        )
