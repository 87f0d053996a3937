"""Conditional flows of other libraries on the same number of points, at their own default sizes, untrained.

Each function builds a flow of two dimensions with CONTEXT condition features and returns its log-density as a
function of points [N, 2], one condition for all of them. Weights do not change how long it takes.
"""

from collections.abc import Callable

import torch
from torch import Tensor

LogProb = Callable[[Tensor], Tensor]

CONTEXT = 16
HIDDEN = (64, 64)


def zuko_flow(name: str, **sizes: object) -> LogProb:
    """A flow of `zuko.flows` by name, 64 units wide."""
    import zuko

    flow = getattr(zuko.flows, name)(2, CONTEXT, hidden_features=HIDDEN, **sizes).eval()
    condition = torch.randn(CONTEXT)
    return lambda x: flow(condition).log_prob(x)


def zuko_naf() -> LogProb:
    """Neural autoregressive flow, one transform whose monotonic network is 64 units wide."""
    return zuko_flow("NAF", transforms=1, network={"hidden_features": HIDDEN})


def nflows_flow(layer: Callable[[], torch.nn.Module], layers: int = 3) -> LogProb:
    """`layers` autoregressive transforms with permutations between them, as in the library's examples."""
    from nflows.distributions import StandardNormal
    from nflows.flows import Flow
    from nflows.transforms import CompositeTransform, ReversePermutation

    parts = [part for _ in range(layers) for part in (ReversePermutation(2), layer())]
    flow = Flow(CompositeTransform(parts), StandardNormal([2])).eval()
    condition = torch.randn(1, CONTEXT)
    return lambda x: flow.log_prob(x, condition.expand(len(x), -1))


def nflows_maf() -> LogProb:
    """Masked affine autoregressive flow."""
    from nflows.transforms import MaskedAffineAutoregressiveTransform

    return nflows_flow(lambda: MaskedAffineAutoregressiveTransform(2, 64, context_features=CONTEXT))


def nflows_nsf() -> LogProb:
    """Autoregressive rational-quadratic spline flow."""
    from nflows.transforms import MaskedPiecewiseRationalQuadraticAutoregressiveTransform as Spline

    return nflows_flow(lambda: Spline(2, 64, context_features=CONTEXT, num_bins=8, tails="linear", tail_bound=5.0))


FLOWS: dict[str, Callable[[], LogProb]] = {
    "zuko NAF (1 transform)": zuko_naf,
    "zuko NSF (3 transforms)": lambda: zuko_flow("NSF", transforms=3),
    "zuko MAF (3 transforms)": lambda: zuko_flow("MAF", transforms=3),
    "nflows NSF (3 transforms)": nflows_nsf,
    "nflows MAF (3 transforms)": nflows_maf,
}
