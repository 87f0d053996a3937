"""What an exact map must cost: operations and bytes by formula, and the time a machine's rates imply.

A dense map of C columns and R rows with S nodes in x evaluates F_2 at S (R + 1) points (x_s, y_j), its cells'
edges. A hidden layer of the second dimension is an H x H product and H tanh at each point; everything that
depends on x alone is done once per node, and once per edge of a column for F_1.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """Of one map: floating-point operations, evaluations of functions, and bytes."""

    gemm: int
    """Operations in H x H products over all points: two for each multiplication with addition."""
    thin: int
    """Operations in first and last layers and in adding contexts, over all points."""
    per_x: int
    """Operations in what depends on x alone: F_1, the contexts, the limits z_2(-) and z_2(+)."""
    tanh: int
    """Evaluations of tanh, those of x alone included."""
    erf: int
    """Evaluations of the error function."""
    theta: int
    """Bytes of the weights."""
    activations: int
    """Bytes of hidden units over all points and layers: what must not leave the cache."""
    result: int
    """Bytes of the map."""

    @property
    def flops(self) -> int:
        """All floating-point operations but those inside tanh and erf."""
        return self.gemm + self.thin + self.per_x


def dense(L: int, H: int, columns: int, rows: int, nodes: float = 1.0) -> Cost:
    """The cost of a dense map with `nodes` nodes per column (on average), for a flow of two dimensions."""
    S = round(columns * nodes)
    points = S * (rows + 1)
    path = 2 * H * H * (L - 1) + 4 * H  # operations of one dimension's own path: inner layers, the two ends
    first = S + columns + 1  # where F_1 is needed
    return Cost(
        gemm=2 * H * H * (L - 1) * points,
        thin=(4 * H + L * H + 1) * points,
        per_x=path * (first + S) + 2 * (2 * H * H * (L - 1) + 2 * H) * S,
        tanh=H * L * (points + first) + 2 * H * (L - 1) * S,
        erf=points + first + 2 * S,
        theta=4 * parameters(L, H),
        activations=4 * H * L * points,
        result=4 * columns * rows,
    )


def evaluated(L: int, H: int, points: float, first: float) -> Cost:
    """The cost of F_2 at so many points and F_1 at `first`, whatever the grid; contexts and limits left out."""
    path = 2 * H * H * (L - 1)
    return Cost(
        gemm=round(path * (points + first)),
        thin=round((4 * H + L * H + 1) * points + 4 * H * first),
        per_x=0,
        tanh=round(H * L * (points + first)),
        erf=round(points + first),
        theta=4 * parameters(L, H),
        activations=round(4 * H * L * (points + first)),
        result=0,
    )


def parameters(L: int, H: int) -> int:
    """P, the length of theta for two dimensions: locations, three blocks and two biases per layer."""
    sizes = [(H, 1), *[(H, H)] * (L - 1), (1, H)]
    return 2 + sum(3 * rows * columns + 2 * rows for rows, columns in sizes)


def floor(cost: Cost, gemm_rate: float, tanh_rate: float) -> float:
    """Seconds a map takes at the least: its products and its tanh at the machine's rates (1/s), nothing else."""
    return cost.gemm / gemm_rate + cost.tanh / tanh_rate
