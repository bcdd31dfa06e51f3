"""The system as a node uses it: frames in, results out, in a process of its own or in this one. No ROS here."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import time
import traceback
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from thegra_core.config import ThegraConfig
from thegra_core.errors import InputError, MappingError, ThegraError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import Frame, MapSummary, Snapshot, TrackingResult
from thegra_core.process import give_back_memory, set_threads
from thegra_ros.beside import Beside, EngineError
from thegra_ros.image_slot import make_slot, put, take

if TYPE_CHECKING:
    from thegra_core.features.protocols import Extractor, Matcher
    from thegra_core.mapping.process import MappingProcess
    from thegra_core.slam import Slam

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Job:
    """A frame and what is wanted beside its result. Another `epoch` than the last job's begins anew: in the map of the file `home`, else in an empty one.

    localization_only: the map stays as it is.
    """

    frame: Frame
    camera: CameraModel
    epoch: int
    wants_view: bool = False
    wants_map: bool = False
    home: Path | None = None
    localization_only: bool = False


@dataclass(frozen=True, slots=True)
class SaveMap:
    """Write the map to a file."""

    path: Path


@dataclass(frozen=True, slots=True)
class BeginIn:
    """Begin in the map of a file. Frames of `epoch` are in it; if it cannot be, they are in the map that was there before."""

    path: Path
    camera: CameraModel
    epoch: int


Order = SaveMap | BeginIn


@dataclass(frozen=True, slots=True)
class Done:
    """A job's result; `view` and `map` where they were wanted and there are any."""

    result: TrackingResult
    view: Snapshot | None = None
    map: MapSummary | None = None


class Engine(Protocol):
    """What works on frames, one at a time."""

    def start(self) -> None:
        """Load the networks.

        Raises:
            ThegraError: If something the user can put right is missing.
        """

    def process(self, job: Job) -> Done:
        """Work on a frame, waiting for the result.

        Raises:
            EngineError: If it failed; the next frame begins a new map.
            ThegraError: If the map of `home` cannot be used; it is tried again with the next job.
        """

    def obey(self, order: Order) -> str:
        """Do what is ordered, waiting for it; what to say about it.

        Raises:
            ThegraError: If it cannot be done; all is as it was.
            EngineError: If it failed.
        """

    def stop(self) -> None:
        """End soon; a frame in work is given up. May be called from any thread."""


class LocalEngine:
    """The system in the calling thread; `beside`: but for mapping, which then has a process of its own."""

    def __init__(self, config: ThegraConfig, beside: bool = False) -> None:
        self._config = config
        self._beside = beside
        self._networks: tuple[Extractor, Matcher] | None = None
        self._slam: Slam | None = None
        self._mapping: MappingProcess | None = None
        self._epoch = -1

    def start(self) -> None:
        set_threads(self._config.threads)
        from thegra_core.features.registry import make_extractor, make_matcher

        self._networks = make_extractor(self._config.extractor), make_matcher(self._config.matcher, self._config.extractor)

    def process(self, job: Job) -> Done:
        try:
            slam = self._slam_for(job)
            result = slam.process(job.frame)
            view = slam.snapshot() if job.wants_view else None
            return Done(result, view, slam.current_map() if job.wants_map else None)
        except MappingError as error:
            self.stop()
            raise EngineError(str(error)) from error
        except ThegraError:
            raise
        except Exception as error:
            self.stop()
            raise EngineError(traceback.format_exc()) from error

    def obey(self, order: Order) -> str:
        try:
            return self._save(order.path) if isinstance(order, SaveMap) else self._begin_in(order)
        except MappingError as error:
            self.stop()
            raise EngineError(str(error)) from error
        except ThegraError:
            raise
        except Exception as error:
            self.stop()
            raise EngineError(traceback.format_exc()) from error

    def stop(self) -> None:
        for ending in (self._slam, self._mapping):
            if ending is not None:
                ending.close()
        self._slam = self._mapping = None

    def _save(self, path: Path) -> str:
        if self._slam is None:
            raise InputError(f"there is no map yet that could be written to {path}")
        self._slam.save_map(path)
        return f"the map is in {path}"

    def _begin_in(self, order: BeginIn) -> str:
        self._epoch = order.epoch  # also where it cannot be: the frames to come are then in the map that is there
        mapping = self._new_mapping(order.camera) if self._beside else None
        made = self._new(order.camera, order.path, mapping)
        self.stop()
        self._slam, self._mapping = made, mapping
        return f"the camera is sought in the map of {order.path}"

    def _slam_for(self, job: Job) -> Slam:
        if self._slam is None or job.epoch != self._epoch:
            self._slam = None
            gc.collect()
            give_back_memory()
            self._slam = self._new(job.camera, job.home, self._emptied_mapping(job.camera) if self._beside else None)
            self._epoch = job.epoch
        self._slam.localization_only = job.localization_only
        return self._slam

    def _emptied_mapping(self, camera: CameraModel) -> MappingProcess:
        """Mapping's process without a map: the one that is there, if it still is."""
        try:
            if self._mapping is not None:
                self._mapping.begin(camera)
                return self._mapping
        except MappingError as error:
            _log.warning("mapping is started again: %s", error)
            self.stop()
        self._mapping = self._new_mapping(camera)
        return self._mapping

    def _new_mapping(self, camera: CameraModel) -> MappingProcess:
        from thegra_core.features.registry import make_frame_matcher
        from thegra_core.mapping.process import MappingProcess

        return MappingProcess(camera, self._config, make_frame_matcher)

    def _new(self, camera: CameraModel, home: Path | None, mapping: MappingProcess | None) -> Slam:
        from thegra_core.optimization.solver import ProcessSolver
        from thegra_core.slam import Slam

        if self._networks is None:
            self.start()
        made = Slam(camera, self._config, *(self._networks or ()), keep_records=False, mapping=mapping, solver=ProcessSolver())
        try:
            if mapping is not None:
                made.warm_up()  # a map that is found before mapping's process is there would be lost again
            if home is not None:
                made.load_map(home)
        except BaseException:
            made.close()
            raise
        return made


class ProcessEngine:
    """The system in a process of its own."""

    def __init__(self, config: ThegraConfig) -> None:
        context = multiprocessing.get_context("spawn")
        self._slot = make_slot(context)
        self._beside = Beside("thegra engine", SlotEngine, config, self._slot, context=context)

    def start(self) -> None:
        self._beside.start()
        self._beside.call("start")

    def process(self, job: Job) -> Done:
        done = self._beside.call("process", replace(job, frame=put(self._slot, job.frame)))
        assert isinstance(done, Done)
        return done

    def obey(self, order: Order) -> str:
        return str(self._beside.call("obey", order))

    def stop(self) -> None:
        self._beside.stop()


class SlotEngine(LocalEngine):
    """What runs in that process: the images of its jobs are in the slot, and mapping has a process of its own."""

    def __init__(self, config: ThegraConfig, slot: Any) -> None:
        super().__init__(config, beside=True)
        self._slot = slot

    def start(self) -> None:
        begin = time.perf_counter()
        super().start()
        _log.info("networks loaded in %.1f s", time.perf_counter() - begin)

    def process(self, job: Job) -> Done:
        return super().process(replace(job, frame=take(self._slot, job.frame)))
