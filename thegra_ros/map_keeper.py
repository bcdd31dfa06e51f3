"""The map of the four nodes: what mapping does with what tracking sends. No ROS here; the node has it in a process of its own, or in its thread."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from thegra_core.config import ThegraConfig
from thegra_core.errors import InputError
from thegra_core.geometry.camera import CameraModel
from thegra_core.messages import InitialMap, Keyframe, MapSummary, MapUpdate
from thegra_core.process import set_threads
from thegra_ros.beside import Beside

if TYPE_CHECKING:
    from thegra_core.features.protocols import Matcher
    from thegra_core.mapping.mapper import Mapper


@dataclass(frozen=True, slots=True)
class Kept:
    """What there is: how many maps, and how many loops were closed in them."""

    maps: int
    loops: int


@dataclass(frozen=True, slots=True)
class Whole:
    """A map for tracking to begin in, and the first numbers that are free for its next map and keyframe."""

    update: MapUpdate
    summary: MapSummary
    next_map: int
    next_keyframe: int


@dataclass(frozen=True, slots=True)
class Growth:
    """What became of a map; the summary where it was wanted."""

    update: MapUpdate
    summary: MapSummary | None
    kept: Kept


class MapKeeper:
    """Owns the maps of one camera."""

    def __init__(self, config: ThegraConfig) -> None:
        self._config = config
        self._matcher: Matcher | None = None
        self._mapper: Mapper | None = None

    def start(self) -> None:
        """Load the networks.

        Raises:
            ThegraError: If something the user can put right is missing.
        """
        set_threads(self._config.threads)
        from thegra_core.features.registry import make_frame_matcher

        self._matcher = make_frame_matcher(self._config)

    def begin(self, camera: CameraModel, home: Path | None) -> Kept:
        """Begin anew: with the map of a file, or empty.

        Raises:
            ThegraError: If the file cannot be used; what there was is kept.
        """
        from thegra_core.mapping.mapper import Mapper
        from thegra_core.optimization.solver import ProcessSolver

        if self._matcher is None:
            self.start()
        assert self._matcher is not None
        made = Mapper(camera, self._config, self._matcher, ProcessSolver())
        if home is not None:
            made.load(home)
        self._mapper = made
        return self._kept(made)

    def whole(self) -> Whole | None:
        """The largest map; None if there is none."""
        mapper = self._mapper
        if mapper is None or not mapper.map_ids:
            return None
        largest = mapper.largest
        keyframes = max(max(mapper.map(i).keyframes) for i in mapper.map_ids)
        return Whole(mapper.whole(largest), mapper.summary(largest), max(mapper.map_ids) + 1, keyframes + 1)

    def grow(self, by: InitialMap | Keyframe, wants_summary: bool) -> Growth | None:
        """Begin or grow a map; None if the map is not known here."""
        mapper = self._mapper
        if mapper is None or (isinstance(by, Keyframe) and by.map_id not in mapper.map_ids):
            return None
        update = mapper.initialize(by) if isinstance(by, InitialMap) else mapper.insert(by)
        return Growth(update, mapper.summary(update.map_id) if wants_summary else None, self._kept(mapper))

    def drop(self, map_id: int) -> Kept:
        """Forget a map, if it is there."""
        assert self._mapper is not None
        self._mapper.drop(map_id)
        return self._kept(self._mapper)

    def save(self, path: Path) -> None:
        """Write the largest map.

        Raises:
            InputError: If there is none, or the file cannot be written.
        """
        if self._mapper is None:
            raise InputError(f"there is no map yet that could be written to {path}")
        self._mapper.save_largest(path)

    def stop(self) -> None:
        """Nothing was started that would not end by itself."""

    @staticmethod
    def _kept(mapper: Mapper) -> Kept:
        return Kept(len(mapper.map_ids), mapper.loops)


class Keeper(Protocol):
    """A `MapKeeper`, wherever it works; its methods are called by name."""

    def start(self) -> None:
        """See `MapKeeper.start`."""

    def call(self, method: str, *arguments: Any) -> Any:
        """Call a method, waiting for what it returns.

        Raises:
            ThegraError, EngineError: If it failed, or was ended.
        """

    def stop(self) -> None:
        """Give up what is in work, and the map. May be called from any thread."""


class KeeperHere:
    """In the calling thread."""

    def __init__(self, config: ThegraConfig) -> None:
        self._keeper = MapKeeper(config)

    def start(self) -> None:
        self._keeper.start()

    def call(self, method: str, *arguments: Any) -> Any:
        return getattr(self._keeper, method)(*arguments)

    def stop(self) -> None:
        self._keeper.stop()


class KeeperBeside:
    """In a process of its own."""

    def __init__(self, config: ThegraConfig) -> None:
        self._beside = Beside("thegra mapping", MapKeeper, config)

    def start(self) -> None:
        self._beside.start()
        self._beside.call("start")

    def call(self, method: str, *arguments: Any) -> Any:
        return self._beside.call(method, *arguments)

    def stop(self) -> None:
        self._beside.stop()
