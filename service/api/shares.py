"""What owners share: none takes more of it than it leaves free, so that another always finds room."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Concatenate, ParamSpec, TypeVar

from service.errors import Busy
from service.inference.cancellation import Cancellation
from service.inference.worker import Outcome, Worker

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Share:
    """The worker, as an owner may use it; ``owner`` is None where there is no other. For the event loop alone."""

    worker: Worker
    taken: Counter[str | None]
    owner: str | None

    async def run(
        self, work: Callable[Concatenate[Cancellation, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> Outcome[T]:
        """As ``Worker.run``. Raises ``Busy`` also where the owner's photographs would leave others too little room."""
        own, everyone = self.taken[self.owner], self.taken.total()
        would_wait = everyone >= self.worker.slots
        if self.owner is not None and would_wait and own + everyone >= self.worker.slots + self.worker.queue_size:
            detail = f"{own} photographs of this owner run or wait, and the room left is for others: try again later."
            raise Busy(detail, retry_after_s=max(1, own))
        self.taken[self.owner] += 1
        try:
            return await self.worker.run_in_line(self.owner, work, *args, **kwargs)
        finally:
            self.taken[self.owner] -= 1
