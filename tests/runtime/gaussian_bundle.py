"""A bundle whose flow is a bivariate Gaussian, so that every answer of the runtime has a closed form.

theta = (mean x, mean y, sigma x, sigma y, rho). The hyper-network drives on at the current speed:
mean x = speed * t, mean y = mean of channel `left` + 2 * mean of channel `shift`, sigmas growing with t.
"""

import hashlib
from pathlib import Path

import numpy as np
import onnx
import onnx.parser

from hcnaf_runtime import manifest as m

_HEAD = '<ir_version: 8, opset_import: ["" : 18]>\n'

_PARTS = """
    zero = Constant<value_ints = [0]>()
    one = Constant<value_ints = [1]>()
    half = Constant<value = float {0.5}>()
    unit = Constant<value = float {1.0}>()
    root2 = Constant<value = float {1.4142135}>()
    sizes = Constant<value_ints = [1, 1, 1, 1, 1]>()
    mx, my, sx, sy, rho = Split<axis = 1>(theta, sizes)
    rho2 = Mul(rho, rho)
    rest = Sub(unit, rho2)
    root = Sqrt(rest)
    s2 = Mul(sy, root)
    ratio = Div(sy, sx)
    slope = Mul(rho, ratio)
"""

_CONDITIONAL = """
    dx = Sub(x, mx)
    lean = Mul(slope, dx)
    m2 = Add(my, lean)
    last = Constant<value_ints = [-1]>()
    m2e = Unsqueeze(m2, last)
    s2e = Unsqueeze(s2, last)
"""


def _phi(value: str, scale: str, out: str) -> str:
    return f"""
    {out}_z = Div({value}, {scale})
    {out}_r = Div({out}_z, root2)
    {out}_e = Erf({out}_r)
    {out}_p = Add(unit, {out}_e)
    {out} = Mul(half, {out}_p)
"""


def _polynomial(variable: str, coefficients: list[float], out: str) -> str:
    """Horner's scheme; coefficients descend."""
    lines = [f"{out}_0 = Constant<value = float {{{coefficients[0]}}}>()"]
    for k, c in enumerate(coefficients[1:], start=1):
        lines.append(f"{out}_c{k} = Constant<value = float {{{c}}}>()")
        lines.append(f"{out}_m{k} = Mul({out}_{k - 1}, {variable})")
        lines.append(f"{out}_{k} = Add({out}_m{k}, {out}_c{k})")
    lines.append(f"{out} = Identity({out}_{len(coefficients) - 1})")
    return "\n    ".join(lines)


_PPND7_CENTRE = (
    [59.109374720, 159.29113202, 50.434271938, 3.3871327179],
    [67.187563600, 78.757757664, 17.895169469, 1.0],
)
_PPND7_TAIL = (
    [0.17023821103, 1.3067284816, 2.7568153900, 1.4234372777],
    [0.12021132975, 0.73700164250, 1.0],
)


def _quantile(u: str, out: str) -> str:
    """Phi^-1 of `u` in [1e-11, 1): Wichura's PPND7 (Algorithm AS 241, 1988)."""
    above, below = _PPND7_CENTRE
    outer, under = _PPND7_TAIL
    return f"""
    {out}_q = Sub({u}, half)
    {out}_q2 = Mul({out}_q, {out}_q)
    {out}_w = Constant<value = float {{0.180625}}>()
    {out}_r = Sub({out}_w, {out}_q2)
    {_polynomial(f"{out}_r", above, f"{out}_ca")}
    {_polynomial(f"{out}_r", below, f"{out}_cb")}
    {out}_cr = Div({out}_ca, {out}_cb)
    {out}_inner = Mul({out}_q, {out}_cr)
    {out}_v = Sub(unit, {u})
    {out}_p = Min({u}, {out}_v)
    {out}_l = Log({out}_p)
    {out}_n = Neg({out}_l)
    {out}_s = Sqrt({out}_n)
    {out}_k = Constant<value = float {{1.6}}>()
    {out}_t = Sub({out}_s, {out}_k)
    {_polynomial(f"{out}_t", outer, f"{out}_ta")}
    {_polynomial(f"{out}_t", under, f"{out}_tb")}
    {out}_tr = Div({out}_ta, {out}_tb)
    {out}_side = Sign({out}_q)
    {out}_outer = Mul({out}_side, {out}_tr)
    {out}_size = Abs({out}_q)
    {out}_edge = Constant<value = float {{0.425}}>()
    {out}_near = LessOrEqual({out}_size, {out}_edge)
    {out} = Where({out}_near, {out}_inner, {out}_outer)
"""


GRAPHS = {
    "marginal_cdf": f"""g (float[B,P] theta, float[B,K] x) => (float[B,K] cdf) {{{_PARTS}
    dx = Sub(x, mx) {_phi("dx", "sx", "cdf")} }}""",
    "conditional_cdf": f"""g (float[B,P] theta, float[B,S] x, float[B,S,E] y) => (float[B,S,E] cdf) {{
    {_PARTS}{_CONDITIONAL}
    dy = Sub(y, m2e) {_phi("dy", "s2e", "cdf")} }}""",
    "cell_mass": f"""g (float[B,P] theta, float[B,S] x, float[B,S,C] weight, float[B,S,C] doubt, float[B,E] y)
    => (float[B,R,C] mass, float[B,C] error, float[B,E,S] cdf) {{
    {_PARTS}{_CONDITIONAL}
    rows = Unsqueeze(y, last)
    middle = Constant<value_ints = [1]>()
    m2s = Unsqueeze(m2, middle)
    s2s = Unsqueeze(s2, middle)
    dy = Sub(rows, m2s) {_phi("dy", "s2s", "cdf")}
    end = Constant<value_ints = [9223372036854775807]>()
    upper = Slice(cdf, one, end, one)
    lower = Slice(cdf, zero, last, one)
    step = Sub(upper, lower)
    raw = MatMul(step, weight)
    mass = Relu(raw)
    off = MatMul(step, doubt)
    size = Abs(off)
    largest = ReduceMax<keepdims = 0>(size, one)
    below = Sub(mass, raw)
    negative = ReduceSum<keepdims = 0>(below, one)
    error = Max(largest, negative) }}""",
    "flow": f"""g (float[B,P] theta, float[B,N,2] points)
    => (float[B,N] log_prob, float[B,N,2] z, float[B,N] log_det) {{
    {_PARTS}
    two = Constant<value_ints = [2]>()
    halves = Constant<value_ints = [1, 1]>()
    xe, ye = Split<axis = 2>(points, halves)
    x = Squeeze(xe, two)
    y = Squeeze(ye, two)
    dx = Sub(x, mx)
    z1 = Div(dx, sx)
    lean = Mul(slope, dx)
    m2 = Add(my, lean)
    dy = Sub(y, m2)
    z2 = Div(dy, s2)
    z1e = Unsqueeze(z1, two)
    z2e = Unsqueeze(z2, two)
    z = Concat<axis = 2>(z1e, z2e)
    area = Mul(sx, s2)
    log_area = Log(area)
    ld = Neg(log_area)
    shape = Shape(z1)
    log_det = Expand(ld, shape)
    q1 = Mul(z1, z1)
    q2 = Mul(z2, z2)
    q = Add(q1, q2)
    hq = Mul(half, q)
    c = Constant<value = float {{1.8378770664}}>()
    lp = Sub(log_det, hq)
    log_prob = Sub(lp, c) }}""",
    "inverse": f"""g (float[B,P] theta, float[B,M,2] uniform)
    => (float[B,M,2] points, float[B,M] log_prob, float[B,M] error) {{
    {_PARTS}
    two = Constant<value_ints = [2]>()
    halves = Constant<value_ints = [1, 1]>()
    ue, ve = Split<axis = 2>(uniform, halves)
    u = Squeeze(ue, two)
    v = Squeeze(ve, two) {_quantile("u", "z1")} {_quantile("v", "z2")}
    dx = Mul(z1, sx)
    x = Add(mx, dx)
    lean = Mul(slope, dx)
    m2 = Add(my, lean)
    dy = Mul(z2, s2)
    y = Add(m2, dy)
    xe = Unsqueeze(x, two)
    ye = Unsqueeze(y, two)
    points = Concat<axis = 2>(xe, ye)
    area = Mul(sx, s2)
    log_area = Log(area)
    q1 = Mul(z1, z1)
    q2 = Mul(z2, z2)
    q = Add(q1, q2)
    hq = Mul(half, q)
    c = Constant<value = float {{1.8378770664}}>()
    whole = Add(hq, c)
    loss = Add(whole, log_area)
    log_prob = Neg(loss)
    error = Sub(loss, loss) }}""",
}

HYPERNET = """g (float[N,R,5] past, int64[A] target, int8[C,H,W] raster, float[T] horizons)
    => (float[A,T,P] theta, float[A,3] pose) {
    zero = Constant<value_ints = [0]>()
    one = Constant<value_ints = [1]>()
    last = Constant<value_ints = [-1]>()
    both = Constant<value_ints = [1, 2]>()
    row = Constant<value = int64 {-1}>()
    now = Gather<axis = 1>(past, row)
    state = Gather<axis = 0>(now, target)
    sizes = Constant<value_ints = [1, 1, 1, 1, 1]>()
    px, py, s, c, v = Split<axis = 1>(state, sizes)
    unit = Constant<value = float {1.0}>()
    above = Add(c, unit)
    tangent = Div(s, above)
    angle = Atan(tangent)
    yaw = Add(angle, angle)
    pose = Concat<axis = 1>(px, py, yaw)
    h = Unsqueeze(horizons, zero)
    mx = Mul(v, h)
    nought = Constant<value = float {0.0}>()
    zeros = Mul(mx, nought)
    image = Cast<to = 1>(raster)
    full = Constant<value = float {127.0}>()
    scaled = Div(image, full)
    means = ReduceMean<keepdims = 0>(scaled, both)
    gains = Constant<value_floats = [1.0, 2.0]>()
    parts = Mul(means, gains)
    shift = ReduceSum<keepdims = 1>(parts, zero)
    my = Add(zeros, shift)
    a = Constant<value = float {0.4}>()
    b = Constant<value = float {0.3}>()
    wide = Mul(h, a)
    sx0 = Add(wide, b)
    sx = Add(zeros, sx0)
    sy = Mul(sx, a)
    r = Constant<value = float {0.6}>()
    rho = Add(zeros, r)
    two = Constant<value_ints = [2]>()
    e1 = Unsqueeze(mx, two)
    e2 = Unsqueeze(my, two)
    e3 = Unsqueeze(sx, two)
    e4 = Unsqueeze(sy, two)
    e5 = Unsqueeze(rho, two)
    theta = Concat<axis = 2>(e1, e2, e3, e4, e5) }"""

CONDITION = """g (float[A,5] condition) => (float[A,T,5] theta) {
    one = Constant<value_ints = [1]>()
    theta = Unsqueeze(condition, one) }"""


def write_gaussian_bundle(folder: Path, kind: str = "pom", **changes: object) -> Path:
    """A bundle of `kind` in `folder`; `changes` replace fields of its manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"hypernet": HYPERNET if kind == "pom" else CONDITION, **GRAPHS}
    graphs, files = {}, {}
    for name, text in texts.items():
        model = onnx.parser.parse_model(_HEAD + text)
        data = model.SerializeToString()
        (folder / f"{name}.onnx").write_bytes(data)
        graphs[name] = _contract(name, model)
        files[f"{name}.onnx"] = m.File(sha256=hashlib.sha256(data).hexdigest(), bytes=len(data))
    fields = _manifest_fields(kind) | {"graphs": graphs, "files": files} | changes
    (folder / m.FILE).write_bytes(m.encode(m.Manifest(**fields)))
    return folder


def _contract(name: str, model: onnx.ModelProto) -> m.Graph:
    def tensor(value: onnx.ValueInfoProto) -> m.Tensor:
        kind = value.type.tensor_type
        shape = [d.dim_param or d.dim_value for d in kind.shape.dim]
        dtype = str(onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type))
        return m.Tensor(name=value.name, dtype=dtype, shape=shape, unit="", description="")

    return m.Graph(
        file=f"{name}.onnx",
        inputs=[tensor(v) for v in model.graph.input],
        outputs=[tensor(v) for v in model.graph.output],
    )


def _manifest_fields(kind: str) -> dict:
    return {
        "name": "gaussian",
        "version": "0",
        "created": "2026-01-01T00:00:00Z",
        "kind": kind,
        "flow": m.Flow(dims=2, layers=2, hidden=20, support="normalised", weight_norm="none", parameters=5),
        "scene": m.SceneContract(step=0.1, history=3, channels=["left", "shift"], optional_channels=["shift"])
        if kind == "pom"
        else None,
        "condition": m.ConditionContract(size=5, names=["mx", "my", "sx", "sy", "rho"])
        if kind == "condition"
        else None,
        "horizons": m.HorizonRange(min=0.0, max=4.0) if kind == "pom" else None,
        "opset": 18,
        "ir_version": 8,
        "onnxruntime_min": "1.20",
    }


def make_theta(mx: float, my: float, sx: float, sy: float, rho: float) -> np.ndarray:
    """theta [1, 5]."""
    return np.array([[mx, my, sx, sy, rho]], np.float32)


def scene_fields(poses=((3.0, -2.0, 0.7), (10.0, 5.0, -1.2)), speeds=(5.0, 2.0)):
    """Constructor arguments of a scene: three rows of history on straight lines, both agents targets."""
    past = np.zeros((len(poses), 3, 5), np.float32)
    for n, ((x, y, yaw), v) in enumerate(zip(poses, speeds, strict=True)):
        for row in range(3):
            back = (2 - row) * 0.1 * v
            past[n, row] = (x - back * np.cos(yaw), y - back * np.sin(yaw), np.sin(yaw), np.cos(yaw), v)
    return {
        "past": past,
        "size": np.tile(np.float32([4.5, 1.8]), (len(poses), 1)),
        "kind": np.ones(len(poses), np.uint8),
        "target": np.arange(len(poses), dtype=np.int64),
        "step": 0.1,
        "raster": np.full((2, 6, 8), 10, np.int8),
        "channels": ("left", "shift"),
        "origin": np.float32([-2, -1]),
        "resolution": 0.5,
    }
