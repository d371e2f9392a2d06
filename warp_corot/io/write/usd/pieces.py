"""A growing USD animation on disk that is valid at every moment, even if the writing process is killed.

If a process dies while it saves a USD file in place, the file does not open. So frames are collected and
written as *pieces*, complete binary files in a folder ``NAME.usd.pieces`` beside the stage, each written under a
temporary name, synced to disk and renamed. After each piece a small root stage that plays all of them (value clips)
replaces the file at the final path in one rename. A thread waits for the disk while the next frames are made. At the
end everything is joined into one file, again written under a temporary name and renamed over the final path, and the
pieces are removed.

Attributes that change only now and then, like the topology of a mesh, have a sample where they change. A clip does not
play samples of former clips, so each piece begins with the current values. Between two samples of equal length OpenUSD
interpolates floating-point arrays, even if their points differ; in that case, the former values
are repeated just before the change.
"""

import contextlib
import os
import re
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import IO, Any

from pxr import Sdf, Tf

from warp_corot.errors import InputError
from warp_corot.io.files.usd import check_stage_path, is_locked, reason, take_lock, usd_name
from warp_corot.io.files.whole import WriteError, sync, writing
from warp_corot.simulation.progress import bar_of

from .clips import declare_attributes, new_root, play_pieces, set_time_range, varying_attributes

# All files that a run's folder ever holds; \w{6} is the ending of OpenUSD's own temporary files.
_OURS = re.compile(r"(piece|part)-\d{6}\.usdc|(part-)?(static|manifest|root|joined)\.usd[ac]?|part-\w+\.\w{6}|lock")
#: How long before a frame [time codes] values that must not be interpolated are repeated.
JUST_BEFORE = 2.0**-10

Samples = dict[str, Any]
"""Values of one frame: attribute path → value."""


class PieceStore:
    """Keeps the frames of one stage: `add` each, then `finish`.

    Args:
        path: The stage, .usd, .usda or .usdc. A former file stays until the first piece is complete.
        flush_seconds: Approximate wall time [s] of frames that a sudden end may lose, besides those of a piece that is
            just being written. It is doubled, and more, if writing would otherwise take more than a fifth of the time.
        flush_bytes: A piece is also written when this much data waits.

    Raises:
        InputError: Another extension, a folder with this name, an output folder that does not exist or is not writable,
            a write-protected file, or another process is writing this stage.
    """

    def __init__(self, path: str | Path, *, flush_seconds: float = 2.0, flush_bytes: int = 256 << 20):
        self.path = Path(path)
        check_stage_path(self.path)
        self.pieces_folder = self.path.with_name(self.path.name + ".pieces")
        self._run = self.pieces_folder / f"run-{uuid.uuid4().hex[:8]}"
        self._lock: IO[str] | None = None
        self._is_open = False
        self._refuse_second_writer(InputError)

        self.custom_data: dict[str, Any] = {}
        """Custom data of the default prim at the last frame."""
        self.layer_data: dict[str, Any] = {}
        """Custom data of the layer at the last frame."""
        self._static: Sdf.Layer | None = None
        self._varying: dict[str, Sdf.ValueTypeName] = {}
        self._root: Sdf.Layer | None = None
        self._follows: dict[str, str] = {}
        self._last: Samples = {}  # the latest value of each attribute
        self._carried: Samples = {}  # the values at the time of the last written piece
        self._pieces: list[tuple[float, float]] = []  # first and last time code of each
        self._repeated: list[frozenset[str]] = []  # the initial values of each piece that are not its own samples
        self._pending: list[tuple[float, Samples]] = []  # not yet in a complete piece
        self._thread = ThreadPoolExecutor(1)
        self._writing: tuple[int, Future[None]] | None = None  # the first waiting frames, which a thread writes now
        self._pending_bytes = 0
        self._flush_seconds = flush_seconds
        self._flush_bytes = flush_bytes
        self._flush_cost = 0.0
        self._last_flush = self._last_add = time.monotonic()
        self._broken = False

    def declare(self, static: Sdf.Layer, follows: Mapping[str, str] | None = None) -> None:
        """Set the layer with everything that does not change; frames give its attributes without a value.

        Its stage metadata (units, axis, frame rate) become those of the stage; it must name a default prim. The first
        frame gives all attributes; later ones may omit those that do not change.

        Args:
            static: The layer.
            follows: For attributes [n] whose things differ after a change, the attribute that a frame gives at that
                change: values before and after it are not interpolated.
        """
        self._static = static
        self._follows = dict(follows or {})
        self._varying = varying_attributes(static)

    def add(self, time_code: float, samples: Samples, nbytes: int) -> None:
        """Add the values of one frame, of size ``nbytes``, and write a piece when it is due.

        Raises:
            OSError: It could not be written, for example because the disk is full; the frames that fit, from the first
                one on, are kept and play.
        """
        if self._broken:
            raise OSError(f"{self.path}: could not be written further, see the error before")
        unknown = samples.keys() - self._varying.keys()
        assert not unknown, f"not declared as varying: {unknown}"
        now = time.monotonic()
        if not self._last:  # time before the first frame cannot lose a frame
            self._last_flush = self._last_add = now
        held = self._held_over(samples)
        if held:
            self._pending.append((time_code - JUST_BEFORE, held))
        self._pending.append((time_code, samples))
        self._pending_bytes += nbytes
        self._last |= samples
        gap, self._last_add = now - self._last_add, now
        interval = max(self._flush_seconds, 4.0 * self._flush_cost)
        # The next frame comes after another gap of this length, which must not exceed the interval.
        if now - self._last_flush + gap > interval or self._pending_bytes >= self._flush_bytes:
            self._flush(now)

    def flush(self) -> None:
        """Write the waiting frames as a piece and let the stage play it.

        Raises:
            OSError: As in `add`.
        """
        self._flush(time.monotonic(), settled=True)

    def _flush(self, now: float, settled: bool = False) -> None:
        try:
            self._settle()
            if self._pending:
                self._begin_piece(len(self._pending))
            if settled:
                self._settle()
        except OSError as error:
            self._broken = True
            self._keep_what_fits(len(self._pending) // 2)
            raise OSError(f"{error}; {self._kept()}") from None
        self._last_flush = now

    def finish(self, transform: Callable[[Samples], Mapping[str, Any]] | None = None) -> None:
        """Join all frames into one file at the final path and remove the pieces.

        Args:
            transform: Called with the values of each frame; returns the changed ones.

        Raises:
            OSError: The joined file could not be written. The pieces stay, and the stage plays them.
        """
        # After an error, which was raised before, the root stage plays the written pieces.
        if self._broken or self._static is None or not self._last:
            self._release()
            return
        joined = Sdf.Layer.CreateAnonymous(self.path.suffix)
        joined.TransferContent(self._static)
        opened: list[Sdf.Layer] = []  # kept open, because the joined layer uses arrays in their mapped files
        try:
            self._settle()
            for time_code, samples in self._with_bar(opened):
                if transform:
                    samples = {**samples, **transform(samples)}
                for path, value in samples.items():
                    joined.SetTimeSample(path, time_code, value)
                set_time_range(joined, time_code)
            self._annotate(joined)
            self._run.mkdir(parents=True, exist_ok=True)
            self._write(joined, self.path, aside=f"part-joined{self.path.suffix}")
        except OSError as error:
            del joined
            self._keep_what_fits(len(self._pending))
            self._release()
            raise OSError(f"{error}; {self._kept()}") from None
        del joined
        opened.clear()
        self._release()
        self._remove_run(self._run)
        self._remove_stale_runs()

    def _begin_piece(self, count: int) -> None:
        """Begin to write the first ``count`` waiting frames as a piece that the stage will play.

        Raises:
            OSError: The run's folder cannot be made.
        """
        if not self._is_open:
            self._open_run()
        frames = self._pending[:count]
        piece = self._run / f"piece-{len(self._pieces):06d}.usdc"
        root = self._root_layer([*self._pieces, (frames[0][0], frames[-1][0])])
        self._writing = count, self._thread.submit(self._write_piece, self._piece_layer(frames), piece, root)
        self._pending_bytes = 0

    def _write_piece(self, layer: Sdf.Layer, piece: Path, root: Sdf.Layer) -> None:
        started = time.monotonic()
        try:
            self._write(layer, piece)
            self._write(root, self.path)
        except OSError:
            with contextlib.suppress(OSError):
                piece.unlink(missing_ok=True)
            raise
        self._flush_cost = time.monotonic() - started

    def _settle(self) -> None:
        """Wait for the piece that is being written, if any.

        Raises:
            OSError: It could not be written; its frames still wait.
        """
        if self._writing is None:
            return
        count, written = self._writing
        wait([written])
        self._writing = None
        written.result()
        frames = self._pending[:count]
        self._pieces.append((frames[0][0], frames[-1][0]))
        self._repeated.append(frozenset(self._carried.keys() - frames[0][1].keys()))
        for _, samples in frames:
            self._carried |= samples
        self._pending = self._pending[count:]
        if len(self._pieces) == 1:
            self._remove_stale_runs()

    def _keep_what_fits(self, count: int) -> None:
        """Write as many of the waiting frames as fit, from the first on, in ever smaller pieces."""
        while self._pending and count:
            times = [time_code for time_code, _ in self._pending]
            if count < len(times) and times[count] - times[count - 1] == JUST_BEFORE:
                count -= 1  # the values repeated just before a frame are written with it
                continue
            try:
                self._begin_piece(count)
                self._settle()
            except OSError:
                count //= 2
            else:
                count = min(count, len(self._pending))
        if not self._pieces:
            self._remove_run(self._run)

    def _kept(self) -> str:
        """The result after a failure, in words."""
        if not self._pieces:
            return "no frame could be kept"
        return (
            f"the frames up to {self._pieces[-1][1]:g} are kept in {self.pieces_folder}, which {self.path.name} plays"
        )

    def _frames(self, opened: list[Sdf.Layer]) -> Iterator[tuple[float, Samples]]:
        """All frames in order, from the pieces and from memory."""
        for index in range(len(self._pieces)):
            name = self._run / f"piece-{index:06d}.usdc"
            try:
                piece = Sdf.Layer.OpenAsAnonymous(usd_name(name))
            except Tf.ErrorException:
                piece = None
            if piece is None:
                raise OSError(f"{self.path}: {name} is no longer there or cannot be read")
            opened.append(piece)
            for time_code in sorted(piece.ListAllTimeSamples()):
                repeated = self._repeated[index] if time_code == self._pieces[index][0] else frozenset()
                own = (path for path in self._varying if path not in repeated)
                values = ((path, piece.QueryTimeSample(path, time_code)) for path in own)
                yield time_code, {path: value for path, value in values if value is not None}
        yield from self._pending

    def _with_bar(self, opened: list[Sdf.Layer]) -> Iterator[tuple[float, Samples]]:
        """All frames; joining them takes as long as the disk needs, and terminals show a bar."""
        count = len(self._pending) + round(sum(last - first + 1.0 for first, last in self._pieces))
        with bar_of(count, "frames", f"joining {self.path.name}") as update:
            for number, frame in enumerate(self._frames(opened), start=1):
                yield frame
                update(number)

    def _held_over(self, samples: Samples) -> Samples:
        """Values that must be repeated just before a frame, so that they are not interpolated with those of the
        frame."""
        changed = (path for path, what in self._follows.items() if what in samples and path in self._last)
        return {path: self._last[path] for path in changed if len(self._last[path]) == len(samples[path])}

    def _piece_layer(self, frames: list[tuple[float, Samples]]) -> Sdf.Layer:
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        self._declare_varying(layer)
        (first, earliest), *later = frames
        for time_code, samples in [(first, self._carried | earliest), *later]:
            for path, value in samples.items():
                layer.SetTimeSample(path, time_code, value)
        layer.startTimeCode = frames[0][0]
        layer.endTimeCode = frames[-1][0]
        return layer

    def _declare_varying(self, layer: Sdf.Layer) -> None:
        assert self._static is not None
        declare_attributes(layer, self._static, self._varying)

    def _root_layer(self, pieces: list[tuple[float, float]]) -> Sdf.Layer:
        assert self._static is not None
        folder = f"./{usd_name(Path(self.pieces_folder.name, self._run.name))}"
        if self._root is None:
            self._root = new_root(self.path.suffix, self._static, folder, pieces[0][0])
        play_pieces(self._root, folder, pieces)
        self._annotate(self._root)
        return self._root

    def _annotate(self, layer: Sdf.Layer) -> None:
        if self.custom_data:
            layer.GetPrimAtPath(f"/{layer.defaultPrim}").SetInfo("customData", self.custom_data)
        if self.layer_data:
            layer.customLayerData = {**layer.customLayerData, **self.layer_data}

    def _open_run(self) -> None:
        """Make the folder of this run with the files that all its pieces share."""
        assert self._static is not None
        self._refuse_second_writer(OSError)
        try:
            self._run.mkdir(parents=True, exist_ok=True)
            self._lock = (self._run / "lock").open("w")
        except OSError as error:
            raise OSError(f"{self.path}: cannot make {self._run} ({error.strerror})") from None
        with contextlib.suppress(OSError):  # some network file systems have no locks
            take_lock(self._lock.fileno())
        self._write(self._static, self._run / "static.usdc")
        manifest = Sdf.Layer.CreateAnonymous(".usda")
        self._declare_varying(manifest)
        self._write(manifest, self._run / "manifest.usda")
        self._is_open = True

    def _write(self, layer: Sdf.Layer, target: Path, aside: str | None = None) -> None:
        """Write a layer completely or not at all: in the run's folder, synced, then renamed over the target."""
        part = self._run / (aside or (f"part-root{target.suffix}" if target == self.path else f"part-{target.name}"))
        if part.name.startswith("part-piece-"):
            part = part.with_name(part.name.replace("part-piece-", "part-"))
        try:
            if not layer.Export(usd_name(part)):
                raise WriteError(f"{self.path}: writing {part.name} failed")
            with writing(self.path):
                sync(part)
                os.replace(part, target)
                sync(target.parent)
        except Tf.ErrorException as error:
            raise WriteError(f"{self.path}: cannot be written: {reason(error)}") from None
        finally:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)

    def _refuse_second_writer(self, kind: type[Exception]) -> None:
        for run in self._other_runs():
            if is_locked(run / "lock"):
                raise kind(f"{self.path}: another process is writing it (its pieces are in {run})")

    def _other_runs(self) -> list[Path]:
        if not self.pieces_folder.is_dir():
            return []
        return [run for run in self.pieces_folder.glob("run-*") if run.is_dir() and run != self._run]

    def _remove_stale_runs(self) -> None:
        """Remove the files that killed runs on this path left, which no stage plays any more."""
        for run in self._other_runs():
            if not is_locked(run / "lock"):
                self._remove_run(run)

    def _remove_run(self, run: Path) -> None:
        """Remove our files from a run's folder, and the folders if they are then empty."""
        if run == self._run:
            self._release()
        with contextlib.suppress(OSError):
            for file in run.iterdir():
                if _OURS.fullmatch(file.name) and file.is_file():
                    file.unlink()
        for folder in (run, self.pieces_folder):
            with contextlib.suppress(OSError):
                folder.rmdir()

    def _release(self) -> None:
        if self._lock:
            self._lock.close()
            self._lock = None
        self._thread.shutdown()
        self._pending, self._root = [], None
