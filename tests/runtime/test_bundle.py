"""A bundle is checked before it is used; verify re-computes its golden outputs."""

import json

import numpy as np
import pytest
from gaussian_bundle import write_gaussian_bundle

from hcnaf_runtime import Bundle, embedded_scenes, manifest, verify
from hcnaf_runtime.errors import BundleError


def _edit(folder, **changes):
    path = folder / manifest.FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_opens_and_runs(bundle):
    assert bundle.manifest.kind == "pom"
    session = bundle.session("marginal_cdf", 1)
    theta = np.float32([[1, 0, 2, 1, 0]])
    (cdf,) = session.run(["cdf"], {"theta": theta, "x": np.float32([[-1e6, 1, 1e6]])})
    np.testing.assert_allclose(cdf, [[0, 0.5, 1]])
    assert bundle.session("marginal_cdf", 1) is session


def test_manifest_round_trip(bundle_path, tmp_path):
    first = manifest.read(bundle_path / manifest.FILE)
    (tmp_path / "m.json").write_bytes(manifest.encode(first))
    assert manifest.read(tmp_path / "m.json") == first


def test_missing_directory(tmp_path):
    with pytest.raises(BundleError, match="no such directory"):
        Bundle.open(tmp_path / "absent")
    with pytest.raises(BundleError, match=r"manifest\.json: no such file"):
        Bundle.open(tmp_path)


@pytest.mark.parametrize("name", ["hypernet.onnx", "cell_mass.onnx"])
def test_missing_and_altered_files(own_bundle, name):
    data = bytearray((own_bundle / name).read_bytes())
    data[-1] ^= 1
    (own_bundle / name).write_bytes(data)
    with pytest.raises(BundleError, match=f"{name}: altered"):
        Bundle.open(own_bundle)
    (own_bundle / name).unlink()
    with pytest.raises(BundleError, match=f"{name}: missing"):
        Bundle.open(own_bundle)


def test_future_format(own_bundle):
    _edit(own_bundle, format=2, novelty=True)
    with pytest.raises(BundleError, match=r"format 2 found, formats 1 to 1 are read; update"):
        Bundle.open(own_bundle)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"novelty": 1}, "unknown field `novelty`"),
        ({"opset": "18"}, "opset"),
        ({"kind": "other"}, "kind"),
        ({"kind": "condition"}, "needs 'condition'"),
        ({"files": {"../x.onnx": {"sha256": "", "bytes": 0}}}, "not a plain name"),
        ({"files": {}}, "is not among the files"),
        ({"format": "new"}, "not a manifest"),
    ],
)
def test_malformed_manifest(own_bundle, changes, message):
    _edit(own_bundle, **changes)
    with pytest.raises(BundleError, match=message) as error:
        Bundle.open(own_bundle)
    assert "\n" not in str(error.value)


def test_not_json(own_bundle):
    (own_bundle / manifest.FILE).write_bytes(b"\xff{")
    with pytest.raises(BundleError, match="not a manifest"):
        Bundle.open(own_bundle)


def test_names_the_graphs_it_has(bundle_path, tmp_path):
    graphs = dict(Bundle.open(bundle_path).manifest.graphs)
    del graphs["cell_mass"]
    bundle = Bundle.open(write_gaussian_bundle(tmp_path / "b", graphs=graphs))
    with pytest.raises(BundleError, match="no graph 'cell_mass'"):
        bundle.session("cell_mass")


def test_graph_and_manifest_must_agree(bundle_path, tmp_path):
    graphs = dict(Bundle.open(bundle_path).manifest.graphs)
    graphs["cell_mass"] = graphs["flow"]
    graphs["flow"] = manifest.Graph(file="hypernet.onnx", inputs=[], outputs=[])
    bundle = Bundle.open(write_gaussian_bundle(tmp_path / "b", graphs=graphs))
    with pytest.raises(BundleError, match="the manifest says"):
        bundle.session("flow")


def test_old_onnxruntime_is_named(tmp_path):
    bundle = Bundle.open(write_gaussian_bundle(tmp_path / "b", onnxruntime_min="99.1"))
    with pytest.raises(BundleError, match=r"99\.1 or newer expected"):
        bundle.session("flow")


def test_a_graph_that_is_not_onnx(tmp_path):
    import hashlib

    folder = write_gaussian_bundle(tmp_path / "b")
    (folder / "flow.onnx").write_bytes(b"nonsense")
    files = json.loads((folder / manifest.FILE).read_text())["files"]
    files["flow.onnx"] = {"sha256": hashlib.sha256(b"nonsense").hexdigest(), "bytes": 8}
    _edit(folder, files=files)
    with pytest.raises(BundleError, match=r"flow.onnx: onnxruntime cannot load it") as error:
        Bundle.open(folder).session("flow")
    assert "\n" not in str(error.value)


def _write_golden(folder):
    bundle = Bundle.open(folder)
    theta = np.float32([[1, 0, 2, 1, 0.3]])
    feeds = {
        "flow": {"theta": theta, "points": np.float32([[[0, 0], [1e6, 0]]])},
        "marginal_cdf": {"theta": theta, "x": np.float32([[0, 1]])},
        "conditional_cdf": {"theta": theta, "x": np.float32([[0]]), "y": np.float32([[[0, 1]]])},
        "cell_mass": {
            "theta": theta,
            "x": np.float32([[0]]),
            "weight": np.float32([[[1]]]),
            "doubt": np.float32([[[1]]]),
            "y": np.float32([[0, 1]]),
        },
        "inverse": {"theta": theta, "uniform": np.float32([[[0.3, 0.6]]])},
        "hypernet": {
            "past": np.ones((1, 3, 5), np.float32),
            "target": np.zeros(1, np.int64),
            "raster": np.zeros((2, 1, 1), np.int8),
            "horizons": np.float32([1]),
        },
    }
    golden = {}
    for graph, tensors in feeds.items():
        session = bundle.session(graph)
        golden |= {f"in.{graph}.{name}": value for name, value in tensors.items()}
        for name, value in zip(session.outputs, session.run(session.outputs, tensors), strict=True):
            golden |= {f"out.{graph}.{name}": value, f"tol.{graph}.{name}": 1e-5}
    return golden


def test_verify(own_bundle):
    golden = _write_golden(own_bundle)
    np.savez(own_bundle / "golden.npz", **golden)
    rows = verify(Bundle.open(own_bundle))
    assert {(row.graph, row.output) for row in rows} >= {("flow", "log_prob"), ("hypernet", "pose")}
    assert all(row.passed and row.max_abs == 0 for row in rows)

    golden["out.marginal_cdf.cdf"] = golden["out.marginal_cdf.cdf"] + np.float32(1e-3)
    golden["out.flow.z"] = np.full_like(golden["out.flow.z"], np.nan)
    np.savez(own_bundle / "golden.npz", **golden)
    failed = {row.output: row for row in verify(Bundle.open(own_bundle)) if not row.passed}
    assert set(failed) == {"z", "cdf"}
    assert failed["cdf"].max_abs == pytest.approx(1e-3, rel=1e-3)


def test_verify_names_what_golden_lacks(own_bundle):
    with pytest.raises(BundleError, match=r"golden.npz: no such file"):
        verify(Bundle.open(own_bundle))
    golden = _write_golden(own_bundle)
    del golden["out.flow.z"]
    np.savez(own_bundle / "golden.npz", **golden)
    with pytest.raises(BundleError, match=r"no 'out\.flow\.z'"):
        verify(Bundle.open(own_bundle))


def test_embedded_scenes_are_scenes():
    assert all(path.suffix == ".npz" and path.is_file() for path in embedded_scenes().values())
