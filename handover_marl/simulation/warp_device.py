"""Device that Warp and PyTorch share."""

import contextlib
from collections.abc import Iterator

import warp

from handover_marl.geometry.arrays import ArrayFactory


class WarpDevice:
    """Device that Warp and PyTorch share; on a GPU, both work in the same stream.

    Args:
        arrays: Creator of tensors on the device.

    Attributes:
        stream: PyTorch's stream on a GPU, else None.
    """

    def __init__(self, arrays: ArrayFactory) -> None:
        self._arrays, self._name = arrays, str(arrays.device)
        self.stream = arrays.xp.cuda.Stream(arrays.device) if arrays.device.type == "cuda" else None

    def synchronize(self) -> None:
        """Wait until the device has done all work in the stream; then arrays that this work reads may be replaced."""
        if self.stream is not None:
            self.stream.synchronize()

    @contextlib.contextmanager
    def use(self) -> Iterator[None]:
        """Make Warp and PyTorch use the device in a `with` block; on a GPU, both work in one stream, in order."""
        with contextlib.ExitStack() as stack:
            stack.enter_context(warp.ScopedDevice(self._name))
            if self.stream is not None:
                cuda = self._arrays.xp.cuda
                outer = cuda.current_stream(self._arrays.device)
                self.stream.wait_stream(outer)
                stack.callback(outer.wait_stream, self.stream)
                stack.enter_context(cuda.stream(self.stream))
                # A graph cannot be captured in the default stream.
                stack.enter_context(warp.ScopedStream(warp.stream_from_torch(self.stream)))
            yield
