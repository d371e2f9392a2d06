"""A growing USD animation on disk that is valid at every moment, even if the writing process is killed.

If a process dies while it saves a USD file in place, the file does not open. So frames are collected and written as
*pieces*, complete binary files in a folder ``NAME.usd.pieces`` beside the stage, each written under a temporary name,
synced to disk and renamed. After each piece a small root stage that plays all of them (value clips) replaces the file
at the final path in one rename. At the end everything is joined into one file, again written under a temporary name and
renamed over the final path, and the pieces are removed.

Attributes that change only now and then, like the topology of a mesh, have a sample where they change. A clip does not
play samples of former clips, so each piece begins with the current values. Between two samples of equal length OpenUSD
interpolates floating-point arrays, even if their points differ; in that case, the former values are repeated just
before the change.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import time
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Tf, Usd, Vt

from warp_corot.errors import InputError
from warp_corot.io.files.usd import STAGE_SUFFIXES, is_locked, reason, take_lock, usd_name
from warp_corot.io.files.whole import WriteError, check_output, sync, writing
from warp_corot.io.pictures.colors import COLORMAP_NAME, round_limit
from warp_corot.simulation.progress import bar_of

#: All files that a run's folder ever holds, with OpenUSD's own temporary ones.
_OURS = re.compile(r"(piece-\d{6}|static|manifest)\.usd[ac]|part[-\w]*\.\w{3,6}|lock")
#: How long before a frame [time codes] values that must not be interpolated are repeated.
JUST_BEFORE = 2.0**-10
#: Values that take memory.
ARRAYS = (Vt.IntArray, Vt.FloatArray, Vt.Vec3fArray, Vt.Vec3iArray, Vt.Vec4iArray)
Samples = dict[str, Any]
"""Values of one frame: attribute path → value."""


def declare(stage: Usd.Stage, values: Samples) -> None:
    """Declare attributes without values; those that their prims' schemas do not have are declared already."""
    for path in map(Sdf.Path, values):
        prim = stage.GetPrimAtPath(path.GetPrimPath())
        if not (attribute := prim.GetAttribute(path.name)).IsAuthored():
            prim.CreateAttribute(path.name, attribute.GetTypeName(), custom=False)


class PieceStore:
    """Keeps the frames of one stage: `declare` what does not change, `add` each frame, then `finish`.

    Args:
        path: The stage, .usd, .usda or .usdc. A former file stays until the first piece is complete.
        flush_seconds: Approximate wall time [s] of frames that a sudden end may lose. It is doubled, and more, if
            writing would otherwise take more than a fifth of the time.
        flush_bytes: A piece is also written when this much data waits.

    Attributes:
        custom_data: Custom data of the default prim at the last frame.
        layer_data: Custom data of the layer at the last frame.

    Raises:
        InputError: Another extension, a folder with this name, an output folder that does not exist or is not writable,
            a write-protected file, or another process is writing this stage.
    """

    def __init__(self, path: str | Path, *, flush_seconds: float = 2.0, flush_bytes: int = 256 << 20):
        self.path = Path(path)
        usd_name(self.path)
        check_output(self.path, STAGE_SUFFIXES)
        self.pieces_folder = self.path.with_name(self.path.name + ".pieces")
        self._run = self.pieces_folder / f"run-{uuid.uuid4().hex[:8]}"
        self._reserve = self._run / "part-reserve.bin"
        self._lock: IO[str] | None = None
        self._refuse_second_writer(InputError)
        self.custom_data: dict[str, Any] = {}
        self.layer_data: dict[str, Any] = {}
        self._static: Sdf.Layer | None = None
        self._varying: dict[str, Sdf.ValueTypeName] = {}
        self._follows: dict[str, str] = {}
        self._last: Samples = {}  # the latest value of each attribute
        self._carried: Samples = {}  # the values at the time of the last piece
        self._pieces: list[tuple[float, float]] = []  # first and last time code of each
        self._repeated: list[frozenset[str]] = []  # the initial values of each piece that are not its own samples
        self._pending: list[tuple[float, Samples]] = []  # not yet in a piece
        self._pending_bytes = 0
        self._flush_seconds, self._flush_bytes, self._flush_cost = flush_seconds, flush_bytes, 0.0
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
        self._static, self._follows = static, dict(follows or {})

        def visit(path: Sdf.Path) -> None:
            spec = static.GetAttributeAtPath(path) if path.IsPropertyPath() else None
            if spec and not spec.HasInfo("default") and not spec.HasInfo("connectionPaths"):
                self._varying[str(path)] = spec.typeName

        static.Traverse(Sdf.Path.absoluteRootPath, visit)

    def add(self, time_code: float, samples: Samples) -> None:
        """Add the values of one frame, and write a piece when it is due.

        Raises:
            OSError: It could not be written, for example because the disk is full; the pieces before play.
        """
        if self._broken:
            raise OSError(f"{self.path}: could not be written further, see the error before")
        unknown = samples.keys() - self._varying.keys()
        assert not unknown, f"not declared as varying: {unknown}"
        now = time.monotonic()
        if not self._last:  # time before the first frame cannot lose a frame
            self._last_flush = self._last_add = now
        changed = (path for path, what in self._follows.items() if what in samples and path in self._last)
        held = {path: self._last[path] for path in changed if len(self._last[path]) == len(samples[path])}
        if held:
            self._pending.append((time_code - JUST_BEFORE, held))
        self._pending.append((time_code, samples))
        self._pending_bytes += sum(memoryview(value).nbytes for value in samples.values() if isinstance(value, ARRAYS))
        self._last |= samples
        gap, self._last_add = now - self._last_add, now
        interval = max(self._flush_seconds, 4.0 * self._flush_cost)
        # The next frame comes after another gap of this length, which must not exceed the interval.
        if now - self._last_flush + gap > interval or self._pending_bytes >= self._flush_bytes:
            self.flush()

    def flush(self) -> None:
        """Write the waiting frames as a piece and let the stage play it.

        Raises:
            OSError: As in `add`.
        """
        if not self._pending:
            return
        started = time.monotonic()
        try:
            self._write_piece()
        except OSError as error:
            self._broken = True
            if not self._pieces:
                self._remove_run(self._run)
            elif self._reserve.exists():
                self._reserve.unlink()
                with contextlib.suppress(OSError):
                    self._write_piece()
            raise OSError(f"{error}; {self._kept()}") from None
        # Reserve as much of the disk as the last piece takes twice: where it fills, that is room for waiting frames.
        wanted = 2 * (self._run / f"piece-{len(self._pieces) - 1:06d}.usdc").stat().st_size
        with contextlib.suppress(OSError, AttributeError), self._reserve.open("ab") as file:
            if file.tell() < wanted:
                os.posix_fallocate(file.fileno(), 0, wanted)
        self._last_flush = time.monotonic()
        self._flush_cost = self._last_flush - started

    def finish(self) -> None:
        """Join all frames, each changed by `last_look`, into one file at the final path and remove the pieces.

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
        count = len(self._pending) + round(sum(last - first + 1.0 for first, last in self._pieces))
        try:
            with bar_of(count, "frames", f"joining {self.path.name}") as update:
                for number, (time_code, samples) in enumerate(self._frames(opened), start=1):
                    for path, value in (samples | self.last_look(samples)).items():
                        joined.SetTimeSample(path, time_code, value)
                    if not joined.HasStartTimeCode():
                        joined.startTimeCode = time_code
                    joined.endTimeCode = time_code
                    update(number)
            self._annotate(joined)
            self._run.mkdir(parents=True, exist_ok=True)
            self._write(joined, self.path)
        except OSError as error:
            del joined
            with contextlib.suppress(OSError):
                self.flush()
            self._release()
            raise OSError(f"{error}; {self._kept()}") from None
        del joined
        opened.clear()
        self._remove_run(self._run)
        self._remove_stale_runs()

    def last_look(self, samples: Samples) -> Samples:
        """The values of a frame that change at the end."""
        return {}

    # --- layers ------------------------------------------------------------------------------------------------------

    def _write_piece(self) -> None:
        if self._lock is None:
            self._open_run()
        frames = self._pending
        piece = self._run / f"piece-{len(self._pieces):06d}.usdc"
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        self._declare_varying(layer)
        (first, earliest), *later = frames
        for time_code, samples in [(first, self._carried | earliest), *later]:
            for path, value in samples.items():
                layer.SetTimeSample(path, time_code, value)
        layer.startTimeCode, layer.endTimeCode = first, frames[-1][0]
        self._write(layer, piece)
        pieces = [*self._pieces, (first, frames[-1][0])]
        try:
            self._write(self._root_layer(pieces), self.path)
        except OSError:
            piece.unlink(missing_ok=True)
            raise
        self._pieces = pieces
        self._repeated.append(frozenset(self._carried.keys() - earliest.keys()))
        self._carried = dict(self._last)
        self._pending, self._pending_bytes = [], 0
        if len(pieces) == 1:
            self._remove_stale_runs()

    def _root_layer(self, pieces: list[tuple[float, float]]) -> Sdf.Layer:
        """The small stage on top of the static layer, which plays pieces beside it, so that both can be moved."""
        assert self._static is not None
        folder = f"./{usd_name(Path(self.pieces_folder.name, self._run.name))}"
        root = Sdf.Layer.CreateAnonymous(self.path.suffix)
        for key in self._static.pseudoRoot.ListInfoKeys():
            if key not in ("startTimeCode", "endTimeCode"):
                root.pseudoRoot.SetInfo(key, self._static.pseudoRoot.GetInfo(key))
        root.subLayerPaths.append(f"{folder}/static.usdc")
        root.startTimeCode, root.endTimeCode = pieces[0][0], pieces[-1][1]
        files = [Sdf.AssetPath(f"{folder}/piece-{index:06d}.usdc") for index in range(len(pieces))]
        active = [(first, float(index)) for index, (first, _) in enumerate(pieces)]
        clips = {
            "assetPaths": Sdf.AssetPathArray(files),
            "active": Vt.Vec2dArray(active),
            "manifestAssetPath": Sdf.AssetPath(f"{folder}/manifest.usda"),
        }
        for name in sorted(
            {f"/{root.defaultPrim}", *(f"/{path.split('/')[1].split('.')[0]}" for path in self._varying)}
        ):
            Sdf.CreatePrimInLayer(root, name).SetInfo("clips", {"default": {**clips, "primPath": name}})
        self._annotate(root)
        return root

    def _declare_varying(self, layer: Sdf.Layer) -> None:
        """Declare the attributes that vary, without values, at the frame rate of the stage."""
        assert self._static is not None
        layer.timeCodesPerSecond = self._static.timeCodesPerSecond
        layer.framesPerSecond = self._static.framesPerSecond
        for path, type_name in self._varying.items():
            prim = Sdf.CreatePrimInLayer(layer, Sdf.Path(path).GetPrimPath())
            Sdf.AttributeSpec(prim, Sdf.Path(path).name, type_name)

    def _annotate(self, layer: Sdf.Layer) -> None:
        if self.custom_data:
            layer.GetPrimAtPath(f"/{layer.defaultPrim}").SetInfo("customData", self.custom_data)
        if self.layer_data:
            layer.customLayerData = {**layer.customLayerData, **self.layer_data}

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

    # --- files -------------------------------------------------------------------------------------------------------

    def _write(self, layer: Sdf.Layer, target: Path) -> None:
        """Write a layer completely or not at all: in the run's folder, synced, then renamed over the target."""
        part = self._run / f"part{target.suffix}"
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

    def _kept(self) -> str:
        """The result after a failure, in words."""
        if not self._pieces:
            return "no frame could be kept"
        return (
            f"the frames up to {self._pieces[-1][1]:g} are kept in {self.pieces_folder}, which {self.path.name} plays"
        )

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
        self._pending = []


class ColoredStage(PieceStore):
    """Frames coloured by stress, all in one range at the end.

    The colour range starts at 0 and ends at the 99th percentile of the highest frame so far, rounded up to few digits
    (`colors.round_limit`). On closing, earlier frames are coloured again with the last range. Custom data of the
    default prim name the colour map and its range.

    Attributes:
        frames: The number of frames so far.
        stress_range: Stresses [Pa] at the two ends of the colour map so far.
    """

    def __init__(self, path: str | Path, *, flush_seconds: float = 2.0):
        super().__init__(path, flush_seconds=flush_seconds)
        self.frames, self.stress_range = 0, (0.0, 0.0)
        self._ranges_used: set[tuple[float, float]] = set()
        self._closed = False

    def widen_range(self, top: float) -> None:
        """Let the colour range reach this stress [Pa]."""
        self.stress_range = (0.0, max(top, self.stress_range[1]))

    @staticmethod
    def range_for(stress: NDArray[np.float32]) -> float:
        """The end of the colour range that a frame with these stresses of its tetrahedra needs [Pa]."""
        if len(stress) == 0:
            return 0.0
        rank = min(len(stress) - 1, int(0.99 * len(stress)))
        # Only the largest few are ranked: those above most of a sample, if enough are.
        sample = np.sort(stress[::97])
        largest = stress[stress >= sample[int(0.98 * len(sample))]]
        if len(largest) >= len(stress) - rank:
            stress, rank = largest, rank + len(largest) - len(stress)
        return round_limit(float(np.partition(stress, rank)[rank]))

    def close(self) -> None:
        """Join all frames into one file and remove the pieces; further calls do nothing.

        Raises:
            OSError: The joined file could not be written; the pieces stay, and the stage plays them.
        """
        if not self._closed:
            self._closed = True
            self.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except OSError as error:
            if kind is None:
                raise
            logging.getLogger(__name__).warning("%s", error)  # the first error is the one to raise

    def last_look(self, samples: Samples) -> Samples:
        return self._colors(samples) if self._ranges_used - {self.stress_range} else {}

    def _check_open(self) -> None:
        if self._closed:
            raise InputError(f"{self.path}: is closed; frames must be added before")

    def _add(self, layer: Sdf.Layer, samples: Samples, stress: NDArray[np.float32] | None, **follows: Any) -> None:
        """Add a frame with stresses of tetrahedra [T] [Pa], if any; the first one declares its attributes in the layer
        with what does not change, and ``follows`` is as for `declare`."""
        if stress is not None:
            self.widen_range(self.range_for(stress))
            self._ranges_used.add(self.stress_range)
            lowest, highest = self.stress_range
            legend = {"map": COLORMAP_NAME, "quantity": "von Mises stress", "unit": "Pa"}
            self.custom_data["stressColors"] = legend | {"lowest": lowest, "highest": highest}
            samples |= self._colors(samples)
        if not self.frames:
            declare(Usd.Stage.Open(layer), samples)
            self.declare(layer, **follows)
        self.add(float(self.frames), samples)
        self.frames += 1

    def _colors(self, samples: Samples) -> Samples:
        """Colours for the stresses of a frame, in the present range."""
        raise NotImplementedError
