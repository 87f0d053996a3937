"""Which part of every batch a process learns from."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

from hcnaf_runtime.errors import RecipeError

B = TypeVar("B", bound=tuple[Any, ...])


class Share(NamedTuple):
    """Part `number` of `parts` equal parts, in order: the parts of all processes are the whole batch."""

    number: int = 0
    parts: int = 1

    def of(self, size: int) -> slice:
        """This part of `size` examples. Raises RecipeError if they cannot be shared out evenly."""
        each, rest = divmod(size, self.parts)
        if rest:
            raise RecipeError(
                f"a batch has {size} examples, which {self.parts} processes cannot share evenly; set "
                f"optimiser.batch to a multiple of {self.parts}, or start another number of processes"
            )
        return slice(self.number * each, (self.number + 1) * each)

    def cut(self, batch: B) -> B:
        """This part of a named tuple of tensors whose first axis is the examples'."""
        if self.parts == 1:
            return batch
        make: Any = type(batch)
        cut: B = make(*(None if v is None else v[self.of(len(v))] for v in batch))
        return cut


WHOLE = Share()
