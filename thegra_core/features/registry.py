"""Names in the configuration to extractors and matchers; torch is imported only when a network is built."""

from __future__ import annotations

from thegra_core.config import ExtractorConfig, MatcherConfig, ThegraConfig
from thegra_core.errors import ConfigError
from thegra_core.features.protocols import Extractor, Matcher
from thegra_core.process import most_threads

EXTRACTOR_WEIGHTS: dict[str, tuple[str, ...]] = {
    "superpoint": ("superpoint_v1",),
    "aliked": ("aliked-n16",),
    "aliked-n16rot": ("aliked-n16rot",),
    "xfeat": ("xfeat",),
    "sift": (),
    "orb": (),
}
"""Every extractor and the weights it needs."""
LEARNED_MATCHERS: dict[str, tuple[str, str]] = {
    "superpoint": ("lightglue", "superpoint_lightglue"),
    "aliked": ("lightglue", "aliked_lightglue"),
    "aliked-n16rot": ("lightglue", "aliked_lightglue"),
    "xfeat": ("lighterglue", "xfeat-lighterglue"),
}
"""Extractor to its learned matcher and that one's weights."""
MATCHERS = ("auto", "lightglue", "lighterglue", "nearest")


def make_extractor(config: ExtractorConfig) -> Extractor:
    """The extractor that `config.name` names.

    Raises:
        ConfigError: If there is none of that name; lists those there are.
        WeightsError: If its weights are not in the cache, with the command that fetches them.
    """
    if config.name == "superpoint":
        from thegra_core.features.superpoint import SuperPoint

        return SuperPoint(config)
    if config.name in ("aliked", "aliked-n16rot"):
        from thegra_core.features.aliked import Aliked

        return Aliked(config)
    if config.name == "xfeat":
        from thegra_core.features.xfeat import XFeat

        return XFeat(config)
    if config.name in ("sift", "orb"):
        from thegra_core.features.classical import Orb, Sift

        return Sift(config) if config.name == "sift" else Orb(config)
    raise ConfigError(f"unknown extractor {config.name!r}; known: {', '.join(EXTRACTOR_WEIGHTS)}")


def make_matcher(config: MatcherConfig, extractor: ExtractorConfig) -> Matcher:
    """The matcher that `config.name` names, for that extractor's features.

    Raises:
        ConfigError: If there is none of that name, or it does not fit the extractor.
        WeightsError: If its weights are not in the cache, with the command that fetches them.
    """
    if matcher_name(config, extractor) == "nearest":
        from thegra_core.features.nearest import Nearest

        return Nearest(config)
    from thegra_core.features.lightglue import LightGlue

    return LightGlue(config, extractor.name)


def make_frame_matcher(config: ThegraConfig, matcher: Matcher | None = None) -> Matcher:
    """The configured matcher, or the one given, for frames as the configured front end makes them.

    Raises:
        ConfigError, WeightsError: As `make_matcher`.
    """
    from thegra_core.features.tracks import TrackMatcher
    from thegra_core.features.turning import TurningMatcher

    learned = TurningMatcher(matcher if matcher is not None else make_matcher(config.matcher, config.extractor))
    return TrackMatcher(learned, config.flow.min_shared) if config.flow.enabled else learned


def make_tracking_matchers(config: ThegraConfig, matcher: Matcher) -> tuple[Matcher, tuple[Matcher, ...]]:
    """For tracking: what pairs each frame with its reference, and what is asked in turn where that finds too little, if anything is: nearest
    descriptors of all keypoints, also of those that are not followed, then the matcher given."""
    from thegra_core.features.hurry import Hurried
    from thegra_core.features.nearest import Nearest
    from thegra_core.features.tracks import TrackMatcher
    from thegra_core.features.turning import TurningMatcher

    first = make_first_matcher(config, matcher)
    if config.tracking.match_by != "nearest":
        return first, ()
    hurried = Hurried(matcher, most_threads()) if config.threads else matcher
    return first, tuple(TrackMatcher(TurningMatcher(each), None) for each in (Nearest(config.matcher), hurried))


def make_first_matcher(config: ThegraConfig, matcher: Matcher | None = None) -> Matcher:
    """What pairs each frame with its reference: nearest descriptors where `tracking.match_by` says so, which loads no network, else as `make_frame_matcher`.

    Raises:
        ConfigError, WeightsError: As `make_matcher`.
    """
    from thegra_core.features.nearest import Nearest

    return make_frame_matcher(config, Nearest(config.matcher) if config.tracking.match_by == "nearest" else matcher)


def matcher_name(config: MatcherConfig, extractor: ExtractorConfig) -> str:
    """What `auto` stands for with that extractor, else the name itself, checked.

    Raises:
        ConfigError: If the matcher is unknown or does not fit the extractor.
    """
    if config.name not in MATCHERS:
        raise ConfigError(f"unknown matcher {config.name!r}; known: {', '.join(MATCHERS)}")
    learned = LEARNED_MATCHERS.get(extractor.name, ("nearest", ""))[0]
    if config.name == "auto":
        return learned
    if config.name not in ("nearest", learned):
        raise ConfigError(f"matcher {config.name!r} does not take {extractor.name} features; use: --set matcher.name={learned}")
    return config.name


def weights_for(extractor: ExtractorConfig, matcher: MatcherConfig) -> tuple[str, ...]:
    """Names of the weights that this pair needs."""
    needed = EXTRACTOR_WEIGHTS.get(extractor.name, ())
    return needed if matcher_name(matcher, extractor) == "nearest" else (*needed, LEARNED_MATCHERS[extractor.name][1])
