"""Something done once, a while after it was last asked for."""

import threading
from collections.abc import Callable


class Later:
    """Calls ``what``, in a thread of its own, when it was not asked for again within ``after_s`` seconds.

    Any thread may ask.
    """

    def __init__(self, what: Callable[[], None], after_s: float) -> None:
        self._what = what
        self._after_s = after_s
        self._asking = threading.Lock()
        self._clock: threading.Timer | None = None

    def ask(self) -> None:
        with self._asking:
            if self._clock is not None:
                self._clock.cancel()
            self._clock = threading.Timer(self._after_s, self._what)
            self._clock.daemon = True
            self._clock.start()

    def stop(self) -> None:
        """What has begun ends, what has not is not begun: a process that ends under a native call is aborted."""
        clock = self._clock
        if clock is not None and clock is not threading.current_thread():
            clock.cancel()
            clock.join()
