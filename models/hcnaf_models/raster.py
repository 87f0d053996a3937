"""What the encoder looks at: the map around an actor, and the boxes of the others drawn into it.

Images are [rows, columns] of an actor-centric `Crop`: column 0 is the farthest behind, row 0 the farthest right.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from hcnaf_models.config import Crop
from hcnaf_models.geometry import from_frame

LATTICE = (10, 3)  # points along and across a box: at most 1.2 m apart on a bus


def pixel_centres(crop: Crop, like: Tensor) -> tuple[Tensor, Tensor]:
    """x [columns] and y [rows] of the pixel centres (m, actor's frame)."""
    x = torch.arange(crop.columns, dtype=like.dtype, device=like.device)
    y = torch.arange(crop.rows, dtype=like.dtype, device=like.device)
    return (x + 0.5) * crop.resolution - crop.behind, (y + 0.5) * crop.resolution - crop.side


def crop_raster(raster: Tensor, origin: Tensor, resolution: Tensor, pose: Tensor, crop: Crop) -> Tensor:
    """The raster seen from each pose, bilinear, zero outside.

    Args:
        raster: [C, H, W] float, row 0 at the lowest y.
        origin: [2], the lower-left corner (m, scene frame). resolution: [1], m per pixel.
        pose: [B, 3], x, y, yaw (scene frame).

    Returns:
        [B, C + 1, rows, columns]; the last plane is 1 inside the raster and 0 outside.
    """
    x, y = pixel_centres(crop, pose)
    local = torch.stack([x.expand(crop.rows, -1), y.unsqueeze(-1).expand(-1, crop.columns)], dim=-1)
    # From the raster's corner: far from the scene's origin float32 metres are coarse, their differences are not.
    place = torch.cat([pose[:, :2] - origin, pose[:, 2:]], dim=-1)
    points = from_frame(local, place[:, None, None, :])  # [B, rows, columns, 2]
    extent = torch.stack([(resolution * raster.shape[-1])[0], (resolution * raster.shape[-2])[0]])
    unit = 2.0 * points / extent - 1.0  # corners of the raster at -1 and +1
    # One tall image for all actors: the raster is read in place, not copied once per actor.
    tall = unit.reshape(1, -1, crop.columns, 2)
    image = grid_sample(raster.unsqueeze(0), tall, mode="bilinear", padding_mode="zeros", align_corners=False)
    image = image.reshape(raster.shape[0], -1, crop.rows, crop.columns).transpose(0, 1)
    inside = (unit.abs().amax(dim=-1) <= 1.0).to(image.dtype).unsqueeze(1)
    return torch.cat([image, inside], dim=1)


def turn_directions(image: Tensor, channels: tuple[str, ...], pose: Tensor) -> Tensor:
    """Turn the planes `direction_x`, `direction_y` of image [B, C, rows, columns] into each actor's frame."""
    if not {"direction_x", "direction_y"} <= set(channels):
        return image
    i, j = channels.index("direction_x"), channels.index("direction_y")
    c = torch.cos(pose[:, 2])[:, None, None]
    s = torch.sin(pose[:, 2])[:, None, None]
    planes = list(image.unbind(1))
    planes[i], planes[j] = c * planes[i] + s * planes[j], c * planes[j] - s * planes[i]
    return torch.stack(planes, dim=1)


def splat_boxes(states: Tensor, size: Tensor, values: Tensor, crop: Crop) -> Tensor:
    """Draw boxes, each as a lattice of points that spread over their four nearest pixels.

    A pixel wholly inside one box receives about the box's value; the sum over pixels is exactly the value
    times the box's area in pixels for boxes inside the window. The cost follows the boxes, not the window.

    Args:
        states: [B, K, 5] in the actor's frame; rows that are not observed are NaN and draw nothing.
        size: [B, K, 2], length and width (m).
        values: [B, K, V], what each box adds to each plane.

    Returns:
        [B, V, rows, columns].
    """
    B, V = states.shape[0], values.shape[-1]
    known = torch.isfinite(states[..., :1])
    s = torch.where(known, states, torch.zeros_like(states))
    columns, rows = _lattice(s, size, crop)  # [B, K, M] in pixels, relative to pixel centres
    area = size[..., 0] * size[..., 1] / (crop.resolution**2 * columns.shape[-1])
    weight = torch.where(known[..., 0], area, torch.zeros_like(area)).unsqueeze(-1)
    index, share = _corners(columns, rows, crop)  # [B, K, M, 4]
    amount = (share * weight.unsqueeze(-1)).reshape(B, 1, -1) * _per_point(values, share).reshape(B, V, -1)
    image = states.new_zeros(B, V, crop.rows * crop.columns)
    image = torch.scatter_add(image, 2, index.reshape(B, 1, -1).expand(-1, V, -1), amount)
    return image.reshape(B, V, crop.rows, crop.columns)


def _lattice(s: Tensor, size: Tensor, crop: Crop) -> tuple[Tensor, Tensor]:
    """Pixel coordinates (column, row) of a LATTICE of points inside each box: [B, K, M] each."""
    n, m = LATTICE
    along = ((torch.arange(n, dtype=s.dtype, device=s.device) + 0.5) / n - 0.5).repeat_interleave(m)
    across = ((torch.arange(m, dtype=s.dtype, device=s.device) + 0.5) / m - 0.5).repeat(n)
    u, v = along * size[..., :1], across * size[..., 1:2]
    x = s[..., 0:1] + u * s[..., 3:4] - v * s[..., 2:3]
    y = s[..., 1:2] + u * s[..., 2:3] + v * s[..., 3:4]
    return (x + crop.behind) / crop.resolution - 0.5, (y + crop.side) / crop.resolution - 0.5


def _corners(columns: Tensor, rows: Tensor, crop: Crop) -> tuple[Tensor, Tensor]:
    """Flat indices of the four pixels around each point and their bilinear shares, zero outside the window."""
    left, low = torch.floor(columns), torch.floor(rows)
    fx, fy = columns - left, rows - low
    i = torch.stack([left, left + 1.0, left, left + 1.0], dim=-1)
    j = torch.stack([low, low, low + 1.0, low + 1.0], dim=-1)
    share = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], dim=-1)
    inside = (i >= 0) & (i <= crop.columns - 1) & (j >= 0) & (j <= crop.rows - 1)
    i, j = torch.clamp(i, 0, crop.columns - 1), torch.clamp(j, 0, crop.rows - 1)
    return (j * crop.columns + i).long(), share * inside.to(share.dtype)


def _per_point(values: Tensor, share: Tensor) -> Tensor:
    """Values [B, K, V] repeated for the points and corners of share [B, K, M, 4]: [B, V, K, M, 4]."""
    B, K, M, corners = share.shape
    return values.transpose(1, 2)[..., None, None].expand(B, values.shape[-1], K, M, corners)
