"""File object for h5py that defers write errors, such as a full disk: HDF5 crashes if a write raises an exception."""

import io


class ErrorDeferringFile(io.FileIO):
    """A file that stores write errors in `error` instead of raising them.

    Data that could not be written stay in memory and are read from there, since HDF5 also crashes if it does not read
    back the bytes that it wrote.
    """

    def __init__(self, *args):
        super().__init__(*args)
        self.error: OSError | None = None
        self._unwritten: list[tuple[int, bytes]] = []  # offset and data

    def write(self, data) -> int:
        rest = memoryview(data).cast("B")
        while len(rest) and self.error is None:
            try:
                rest = rest[super().write(rest) :]
            except OSError as error:
                self.error = error
        if len(rest):
            self._unwritten.append((self.tell(), bytes(rest)))
            self.seek(len(rest), io.SEEK_CUR)
        return len(data)

    def readinto(self, buffer) -> int:
        view, start = memoryview(buffer).cast("B"), self.tell()
        count = super().readinto(view) or 0
        view[count:] = bytes(len(view) - count)
        for at, data in self._unwritten:
            low, high = max(at, start), min(at + len(data), start + len(view))
            if low < high:
                view[low - start : high - start] = data[low - at : high - at]
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def flush(self) -> None:
        """Writes are not buffered."""

    def check(self) -> None:
        """Raise the stored OSError, if any."""
        if self.error is not None:
            raise self.error
