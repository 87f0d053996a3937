"""From the hyper-network's raw numbers to theta, ready to multiply.

    raw [..., gains + P - D] --exp on diagonal blocks--> weight normalisation --units--> theta [..., P]

Units: the flow works on u = (x - m) / s with a location m and a scale s per dimension, both emitted. With slopes
k_dr, emitted too, the first layer's W_dd takes u_d - sum_{r<d} k_dr u_r: then a Gaussian with a full covariance
asks no more of the flow than one without. m leads theta, s and k are folded into the first layer, so theta takes
x in natural units and gives densities per natural unit, with no other code having to know.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

from hcnaf_models.flow import Layer, layers
from hcnaf_models.spec import FlowSpec, lower_pairs

LOG_GAIN_BOUND = 4.0
"""Gains that depend on the condition lie within a factor e^4 of those that do not."""


class Emission(nn.Module):
    """raw, location, scale -> theta.

    Args:
        spec: the flow's sizes and weight normalisation. `row` and `frobenius` learn one log-gain per output
            row or per layer, independent of the condition, initialised log U(0, 1). To these, `row-gain` adds a
            bounded log-gain per output row that is emitted with the weights.
    """

    def __init__(self, spec: FlowSpec) -> None:
        super().__init__()
        self.spec = spec
        self.log_gains = nn.ParameterList()
        for k in range(1, spec.layers + 2) if spec.weight_norm != "none" else ():
            shape = () if spec.weight_norm == "frobenius" else (spec.dims, spec.fan_out(k))
            self.log_gains.append(nn.Parameter(torch.log(torch.rand(shape).clamp(min=1e-3))))

    def forward(self, raw: Tensor, location: Tensor, scale: Tensor, slope: Tensor | None = None) -> Tensor:
        """theta [..., P] from raw [..., spec.raw] and units.

        Args:
            raw: what the head emits. location, scale: [..., D] in natural units, scale > 0.
            slope: k [..., D (D - 1) / 2] in theta's order of pairs, in scales per scale; None for none.
        """
        parts = torch.split(raw, [*self.spec.gains, *self.spec.groups[1:]], dim=-1)
        gains, groups = parts[: len(self.spec.gains)], parts[len(self.spec.gains) :]
        out = [location]
        for k, layer in enumerate(layers(self.spec, groups)):
            gain = gains[k] if gains else None
            layer = self._normalise(k, layer._replace(diagonal=torch.exp(layer.diagonal)), gain)
            if k == 0:
                layer = self._to_natural_units(layer if slope is None else self._slanted(layer, slope), scale)
            out += [v.reshape(*raw.shape[:-1], -1) for v in layer]
        return torch.cat(out, dim=-1)

    def _normalise(self, k: int, layer: Layer, emitted: Tensor | None) -> Layer:
        if self.spec.weight_norm == "none":
            return layer
        squares = self._row_squares(layer)  # [..., D, H_out]
        if self.spec.weight_norm == "frobenius":
            squares = squares.sum((-1, -2), keepdim=True).expand_as(squares)
        log_gain = self.log_gains[k]
        if emitted is not None:
            log_gain = log_gain + bounded(emitted, LOG_GAIN_BOUND).reshape(squares.shape)
        gain = torch.exp(log_gain) * torch.rsqrt(squares + 1e-24)
        rows = list(lower_pairs(self.spec.dims)[0])
        return Layer(layer.diagonal * gain.unsqueeze(-1), layer.lower * gain[..., rows, :, None], layer.bias)

    def _row_squares(self, layer: Layer) -> Tensor:
        """Sum of squares of every output row, off-diagonal blocks included: [..., D, H_out]."""
        own, lower = layer.diagonal.square().sum(-1), layer.lower.square().sum(-1)
        starts = [d * (d - 1) // 2 for d in range(self.spec.dims + 1)]
        # The first dimension has no blocks below the diagonal. Its zeros are written out: over an empty axis
        # onnxruntime's ReduceSum returns an empty tensor (onnxruntime #8146).
        none = torch.zeros_like(own[..., 0, :])
        parts = [lower[..., a:b, :].sum(-2) if b > a else none for a, b in pairwise(starts)]
        return own + torch.stack(parts, dim=-2)

    def _slanted(self, layer: Layer, slope: Tensor) -> Layer:
        """W_dd (v_d - sum k_dr v_r) + sum W_dr v_r = W_dd v_d + sum (W_dr - W_dd k_dr) v_r."""
        rows = list(lower_pairs(self.spec.dims)[0])
        return layer._replace(lower=layer.lower - layer.diagonal[..., rows, :, :] * slope[..., None, None])

    def _to_natural_units(self, layer: Layer, scale: Tensor) -> Layer:
        """W u = (W / s) (x - m)."""
        columns = list(lower_pairs(self.spec.dims)[1])
        return layer._replace(
            diagonal=layer.diagonal / scale[..., None, None],
            lower=layer.lower / scale[..., columns, None, None],
        )


def bounded(v: Tensor, bound: float) -> Tensor:
    """A smooth clamp to (-bound, bound), the identity near 0."""
    return bound * torch.tanh(v / bound)


def initial_raw(spec: FlowSpec, generator: torch.Generator | None = None, slope: float = 1.5) -> Tensor:
    """A standard initialisation of raw [spec.raw]: the bias of zero-weight heads.

    First-layer units tile u in [-3, 3] with slopes around `slope`, inner rows sum to about 2, last rows to about
    4, so that the flow starts as a smooth map of u onto most of the base's range; coupling blocks start near zero.
    Slopes of H / 6 let units overlap with their neighbours alone: a density with many modes is found much sooner.
    """
    H, D = spec.hidden, spec.dims
    out: list[Tensor] = [torch.zeros(sum(spec.gains))]
    for k in range(1, spec.layers + 2):
        rows, cols = spec.fan_out(k), spec.fan_in(k)
        jitter = 0.3 * torch.randn(D, rows, cols, generator=generator)
        if k == 1:
            diagonal = jitter + math.log(slope)
            bias = -torch.exp(diagonal.squeeze(-1)) * _spaced(H, 3.0)
        elif k <= spec.layers:
            diagonal = jitter + math.log(2.0 / H)
            bias = _spaced(H, 1.5).expand(D, H)
        else:
            diagonal, bias = jitter + math.log(4.0 / H), torch.zeros(D, 1)
        lower = 0.1 / math.sqrt(cols) * torch.randn(spec.pairs, rows, cols, generator=generator)
        out += [diagonal.flatten(), lower.flatten(), bias.flatten()]
    return torch.cat(out)


def _spaced(count: int, bound: float) -> Tensor:
    """`count` numbers evenly over [-bound, bound]; a single one is 0."""
    return torch.linspace(-bound, bound, count) if count > 1 else torch.zeros(1)
