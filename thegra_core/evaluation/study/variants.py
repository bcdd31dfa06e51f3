"""What the study compares: filter chains (the paper's Figs. 3 and 4) and front ends (its Fig. 2)."""

from __future__ import annotations

from dataclasses import dataclass

from thegra_core.config import (
    BandPass,
    Bilateral,
    ChambolleTv,
    Clahe,
    Destripe,
    ExtractorConfig,
    HistogramCdf,
    HistogramClip,
    MatcherConfig,
    Median,
    PercentileStretch,
    PreprocessingConfig,
    Section,
    SvdDestripe,
)


@dataclass(frozen=True, slots=True)
class FrontEnd:
    """A detector with its matcher."""

    extractor: ExtractorConfig
    matcher: MatcherConfig


def _chain(*filters: Section) -> PreprocessingConfig:
    return PreprocessingConfig.model_validate({"filters": [f.model_dump() for f in filters]})


CHAINS: dict[str, PreprocessingConfig] = {
    "stretch": _chain(PercentileStretch()),
    "HE": _chain(HistogramClip()),
    "HE + median": _chain(HistogramClip(), Median()),
    "CLAHE": _chain(PercentileStretch(), Clahe()),
    "CLAHE + median": _chain(PercentileStretch(), Clahe(), Median()),
    "band-pass + HE + median": _chain(BandPass(), HistogramClip(), Median()),
    "bilateral + HE + median": _chain(Bilateral(), HistogramClip(), Median()),
    "Chambolle + HE + median": _chain(ChambolleTv(), HistogramClip(), Median()),
    "Chambolle by noise + HE + median": _chain(ChambolleTv(weight=1.0, unit="noise"), HistogramClip(), Median()),
    "Chambolle + equalisation + median": _chain(ChambolleTv(), HistogramCdf(), Median()),
    "destripe + Chambolle + HE + median": _chain(Destripe(), ChambolleTv(), HistogramClip(), Median()),
    "SVD + Chambolle + HE + median": _chain(SvdDestripe(), ChambolleTv(), HistogramClip(), Median()),
}
"""Name to filters. HE is the paper's two-tail clip; CLAHE works on 8 bit, as the paper's did."""

PAPER_CHAIN = "Chambolle + HE + median"

FRONT_ENDS: dict[str, FrontEnd] = {
    "SuperPoint + LightGlue": FrontEnd(ExtractorConfig(name="superpoint", crowding=0.0, subpixel=False), MatcherConfig()),
    "ALIKED + LightGlue": FrontEnd(ExtractorConfig(name="aliked"), MatcherConfig()),
    "XFeat + LighterGlue": FrontEnd(ExtractorConfig(name="xfeat"), MatcherConfig()),
    "XFeat": FrontEnd(ExtractorConfig(name="xfeat"), MatcherConfig(name="nearest")),
    "SIFT": FrontEnd(ExtractorConfig(name="sift"), MatcherConfig(name="nearest")),
    "ORB": FrontEnd(ExtractorConfig(name="orb"), MatcherConfig(name="nearest")),
}
"""Name to detector and matcher; without a learned matcher mutual nearest neighbours with a ratio test."""
