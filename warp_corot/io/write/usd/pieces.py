"""A growing USD animation on disk that opens at every moment, whatever ends the process that writes it.

A USD file saved again and again in place does not open when the process dies while saving. So frames are collected and
written aside as *pieces*, complete binary files in a folder ``NAME.usd.pieces`` beside the stage, each written under a
temporary name, synced to disk and renamed. After each piece a small root stage that plays all of them (value clips)
replaces the file at the final path in one rename. At the end everything is joined into one file, again written aside
and renamed over the final path, and the pieces are removed.

Attributes that only change now and then, as the topology of a mesh does, have a sample where they change. A clip plays
nothing from the one before, so that each piece begins with what holds then. Between two samples of one length OpenUSD
interpolates floating-point arrays, and it cannot know that their points are others; so where that would be, what was
holds until just before the change.
"""

import contextlib
import os
import re
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from pxr import Sdf, Tf

from warp_corot.errors import InputError
from warp_corot.io.files.usd import check_stage_path, is_locked, reason, take_lock, usd_name
from warp_corot.io.files.whole import sync

from .clips import declare_attributes, new_root, play_pieces, set_time_range, varying_attributes

# All that a run's folder ever holds; \w{6} is what OpenUSD's own temporary files end in.
_OURS = re.compile(r"(piece|part)-\d{6}\.usdc|(part-)?(static|manifest|root|joined)\.usd[ac]?|part-\w+\.\w{6}|lock")
#: How long before a frame [time codes] what is not to be interpolated still holds.
JUST_BEFORE = 2.0**-10

Samples = dict[str, Any]
"""Values of one frame: attribute path → value."""


class PieceStore:
    """Keeps the frames of one stage: `add` each, then `finish`.

    Args:
        path: The stage, .usd, .usda or .usdc. A file there stays as it is until the first piece is complete.
        flush_seconds: About the most wall time [s] of frames that a sudden end may lose. Doubled and more where
            writing is so slow that it would take more than a fifth of the time.
        flush_bytes: A piece is also written when this much data waits.

    Raises:
        InputError: Another extension, a folder in the way, an output folder that is not there or not writable,
            a write-protected file, or another process that is writing this very stage.
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
        """Custom data of the default prim as of the last frame added."""
        self.layer_data: dict[str, Any] = {}
        """The same of the layer."""
        self._static: Sdf.Layer | None = None
        self._varying: dict[str, Sdf.ValueTypeName] = {}
        self._root: Sdf.Layer | None = None
        self._follows: dict[str, str] = {}
        self._last: Samples = {}  # the latest value of each attribute
        self._carried: Samples = {}  # as they were when the last piece was written
        self._pieces: list[tuple[float, float]] = []  # first and last time code of each
        self._repeated: list[frozenset[str]] = []  # what each piece begins with that is no sample of its own
        self._pending: list[tuple[float, Samples]] = []
        self._pending_bytes = 0
        self._flush_seconds = flush_seconds
        self._flush_bytes = flush_bytes
        self._flush_cost = 0.0
        self._last_flush = self._last_add = time.monotonic()
        self._broken = False

    def declare(self, static: Sdf.Layer, follows: Mapping[str, str] | None = None) -> None:
        """Takes the layer with all that does not change; its attributes without a value are the ones that frames give.

        Its stage metadata (units, axis, frame rate) become those of the stage; it must name a default prim. The first
        frame gives all attributes; later ones may leave out what stays as it is.

        Args:
            static: The layer.
            follows: For attributes [n] of things that are other ones after a change, the attribute that a frame gives
                if they are: values before and after are not interpolated.
        """
        self._static = static
        self._follows = dict(follows or {})
        self._varying = varying_attributes(static)

    def add(self, time_code: float, samples: Samples, nbytes: int) -> None:
        """Takes the values of one frame, ``nbytes`` of them, and writes a piece when it is time to.

        Raises:
            OSError: Could not be written, as when the disk is full; the frames for which there is room, from the first
                on, stay and play.
        """
        if self._broken:
            raise OSError(f"{self.path}: could not be written further, see the error before")
        unknown = samples.keys() - self._varying.keys()
        assert not unknown, f"not declared as varying: {unknown}"
        now = time.monotonic()
        if not self._pieces and not self._pending:  # what came before the first frame is no frame to lose
            self._last_flush = self._last_add = now
        held = self._held_over(samples)
        if held:
            self._pending.append((time_code - JUST_BEFORE, held))
        self._pending.append((time_code, samples))
        self._pending_bytes += nbytes
        self._last |= samples
        gap, self._last_add = now - self._last_add, now
        interval = max(self._flush_seconds, 4.0 * self._flush_cost)
        # The next frame comes after another such gap: waiting for it must not outlast the interval.
        if now - self._last_flush + gap > interval or self._pending_bytes >= self._flush_bytes:
            self.flush()

    def flush(self) -> None:
        """Writes the frames that wait as a piece and lets the stage play it.

        Raises:
            OSError: as `add`.
        """
        if not self._pending:
            return
        started = time.monotonic()
        try:
            self._write_piece(len(self._pending))
        except OSError as error:
            self._broken = True
            self._keep_what_fits(len(self._pending) // 2)
            raise OSError(f"{error}; {self._kept()}") from None
        self._last_flush = time.monotonic()
        self._flush_cost = self._last_flush - started

    def finish(self, transform: Callable[[Samples], Mapping[str, Any]] | None = None) -> None:
        """Joins all frames into one file at the final path and removes the pieces.

        Args:
            transform: Called with the values of each frame; returns those that change.

        Raises:
            OSError: The joined file could not be written. The pieces stay, and the stage plays them.
        """
        if self._broken:  # the error has been raised before; the root stage plays what there is
            self._release()
            return
        if self._static is None or not (self._pieces or self._pending):
            self._release()
            return
        joined = Sdf.Layer.CreateAnonymous(self.path.suffix)
        joined.TransferContent(self._static)
        opened: list[Sdf.Layer] = []  # kept open: the joined layer's arrays lie in their mapped files
        try:
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

    def _write_piece(self, count: int) -> None:
        """Write the first ``count`` frames that wait as a piece, and let the stage play it.

        Raises:
            OSError: It cannot be written; all frames wait as before.
        """
        if not self._is_open:
            self._open_run()
        frames = self._pending[:count]
        piece = self._run / f"piece-{len(self._pieces):06d}.usdc"
        first, last = frames[0][0], frames[-1][0]
        try:
            self._write(self._piece_layer(frames), piece)
            self._write(self._root_layer([*self._pieces, (first, last)]), self.path)
        except OSError:
            with contextlib.suppress(OSError):
                piece.unlink(missing_ok=True)
            raise
        self._pieces.append((first, last))
        self._repeated.append(frozenset(self._carried.keys() - frames[0][1].keys()))
        for _, samples in frames:
            self._carried |= samples
        self._pending = self._pending[count:]
        self._pending_bytes = 0 if not self._pending else self._pending_bytes
        if len(self._pieces) == 1:
            self._remove_stale_runs()

    def _keep_what_fits(self, count: int) -> None:
        """Write as many of the frames that wait as there is room for, from the first on, in ever smaller pieces."""
        while self._pending and count:
            times = [time_code for time_code, _ in self._pending]
            if count < len(times) and times[count] - times[count - 1] == JUST_BEFORE:
                count -= 1  # what holds until just before a frame goes with it
                continue
            try:
                self._write_piece(count)
            except OSError:
                count //= 2
            else:
                count = min(count, len(self._pending))
        if not self._pieces:
            self._remove_run(self._run)

    def _kept(self) -> str:
        """After a failure: what is left, in words."""
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
        """The same; joining them takes as long as the disk does, and terminals show how far it is."""
        from tqdm import tqdm

        count = len(self._pending) + round(sum(last - first + 1.0 for first, last in self._pieces))
        form = "{desc}  {percentage:3.0f} % |{bar}| frame {n_fmt} of {total_fmt}, {remaining} left"
        with tqdm(
            total=count, desc=f"joining {self.path.name}", delay=2.0, leave=False, disable=None, bar_format=form
        ) as bar:
            for frame in self._frames(opened):
                yield frame
                bar.update()

    def _held_over(self, samples: Samples) -> Samples:
        """What must be said to hold until just before a frame, lest it is interpolated with what the frame gives."""
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
        """Makes the folder of this run with what all its pieces share."""
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
        """Writes a layer wholly or not at all: aside in the run's folder, synced, then renamed over the target."""
        part = self._run / (aside or (f"part-root{target.suffix}" if target == self.path else f"part-{target.name}"))
        if part.name.startswith("part-piece-"):
            part = part.with_name(part.name.replace("part-piece-", "part-"))
        try:
            if not layer.Export(usd_name(part)):
                raise OSError(f"{self.path}: writing {part.name} failed")
            sync(part)
            os.replace(part, target)
            sync(target.parent)
        except Tf.ErrorException as error:
            raise OSError(f"{self.path}: cannot be written: {reason(error)}") from None
        except OSError as error:
            raise OSError(f"{self.path}: cannot be written: {error.strerror or error}") from None
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
        """Removes what killed runs on this path left: nothing plays it any more."""
        for run in self._other_runs():
            if not is_locked(run / "lock"):
                self._remove_run(run)

    def _remove_run(self, run: Path) -> None:
        """Removes the files that are ours from a run's folder, and the folders if nothing else is in them."""
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
        self._pending, self._root = [], None
