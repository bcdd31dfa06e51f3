"""Every parameter of Thegra: one pydantic model with defaults, units, ranges and where each value comes from.

Sources named in the descriptions: `paper` = arXiv 2602.08531; `ORB-SLAM3` = Campos et al. 2021 and its published constants;
`measured` = chosen on real thermal recordings by the benchmarks of this repository.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from thegra_core.errors import ConfigError

PROFILES = ("paper", "quality", "fast", "realtime")
RUN_FACTS = "run"
"""Key of a run's `config.yaml` that tells what it was run on; no parameter."""


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, values cannot change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


# ---- preprocessing (paper Sec. III-B and IV-B) -------------------------------------------------------------------------------------


class ChambolleTv(Section):
    """Total-variation denoising (Chambolle 2004)."""

    filter: Literal["chambolle_tv"] = "chambolle_tv"
    weight: float = Field(4.0, gt=0, description="how much is smoothed away; paper: 4 grey levels")
    unit: Literal["grey_levels", "noise"] = Field("grey_levels", description="of the weight: those of the array it gets, or standard deviations of that frame's noise")
    eps: float = Field(2e-4, gt=0, description="relative change of the cost that stops the iteration; scikit-image default")
    max_iterations: int = Field(200, ge=1, description="scikit-image default")


class HistogramClip(Section):
    """Two-tail clip and linear map to 8 bit: the authors' "histogram equalisation, cumulative pixel count 10000"."""

    filter: Literal["he_clip"] = "he_clip"
    tail_fraction: float = Field(10000 / (640 * 512), ge=0, lt=0.5, description="share of pixels beyond each limit; paper: 10000 px of 640x512")
    fold: bool = Field(False, description="mirror values below the lower limit instead of clamping them, as the authors' 2024 script did")


class HistogramCdf(Section):
    """Classical histogram equalisation by the cumulative distribution, to 8 bit (Pizer et al. 1987)."""

    filter: Literal["he_cdf"] = "he_cdf"


class Clahe(Section):
    """Contrast-limited adaptive histogram equalisation (Zuiderveld 1994) on 8 or 16 bit."""

    filter: Literal["clahe"] = "clahe"
    clip_limit: float = Field(2.0, gt=0, description="paper: 2")
    tiles: int = Field(8, ge=1, le=64, description="tiles a side; paper: 8")


class Median(Section):
    """Median of a square window."""

    filter: Literal["median"] = "median"
    size: Literal[3, 5] = Field(3, description="px; paper: 3")


class BandPass(Section):
    """Binary ring in the centred 2-D spectrum, radii in bins of the full image."""

    filter: Literal["band_pass"] = "band_pass"
    low: float = Field(0.0, ge=0, description="FFT bins; paper: 0")
    high: float = Field(87.0, gt=0, description="FFT bins; paper: 87")


class Bilateral(Section):
    """Bilateral filter (Tomasi and Manduchi 1998)."""

    filter: Literal["bilateral"] = "bilateral"
    diameter: int = Field(4, ge=1, le=15, description="px; paper: 4")
    sigma_color: float = Field(35.0, gt=0, description="grey levels; not in the paper, taken equal to sigma_space")
    sigma_space: float = Field(35.0, gt=0, description="px; paper: 35")


class PercentileStretch(Section):
    """Linear map of a percentile range to 8 bit."""

    filter: Literal["stretch"] = "stretch"
    low: float = Field(1.0, ge=0, lt=50, description="per cent")
    high: float = Field(99.0, gt=50, le=100, description="per cent")


class KelvinWindow(Section):
    """Linear map of a fixed range of temperatures to 8 bit, for radiometric streams."""

    filter: Literal["kelvin_window"] = "kelvin_window"
    low_k: float = Field(283.15, gt=0, description="K; 10 degrees Celsius")
    high_k: float = Field(313.15, gt=0, description="K; 40 degrees Celsius")
    kelvin_per_count: float = Field(0.01, gt=0, description="K; Lepton and Boson TLinear at high resolution: 0.01, at low: 0.1")
    kelvin_at_zero: float = Field(0.0, description="K; temperature of count 0")

    @model_validator(mode="after")
    def _ordered(self) -> KelvinWindow:
        if not self.high_k > self.low_k:
            raise ValueError(f"high_k {self.high_k:g} must lie above low_k {self.low_k:g}")
        return self


class DifferenceOfGaussians(Section):
    """What lies between two scales (Wang et al. 2023 make edges of it)."""

    filter: Literal["difference_of_gaussians"] = "difference_of_gaussians"
    sigma_fine: float = Field(1.0, gt=0, le=50, description="px")
    sigma_coarse: float = Field(4.0, gt=0, le=100, description="px")


class Destripe(Section):
    """Offset of each column and row taken off."""

    filter: Literal["destripe"] = "destripe"
    columns: bool = Field(True, description="repair columns: vertical stripes")
    rows: bool = Field(False, description="repair rows: horizontal stripes")
    width: int = Field(21, ge=3, le=255, description="px over which slow changes, which are the scene's, are told from stripes")


class SvdDestripe(Section):
    """Vertical stripes taken off as singular components, as Jiang et al. 2022 propose."""

    filter: Literal["svd_destripe"] = "svd_destripe"
    components: int = Field(1, ge=1, le=8, description="singular components taken for stripes")
    width: int = Field(15, ge=3, le=255, description="px over which slow changes, which are the scene's, are told from stripes")


class RepairDeadPixels(Section):
    """Single pixels far from all their neighbours replaced."""

    filter: Literal["repair_dead_pixels"] = "repair_dead_pixels"
    threshold: float = Field(8.0, gt=0, description="times the usual difference of neighbours")


Filter = Annotated[
    ChambolleTv
    | HistogramClip
    | HistogramCdf
    | Clahe
    | Median
    | BandPass
    | Bilateral
    | DifferenceOfGaussians
    | PercentileStretch
    | KelvinWindow
    | Destripe
    | SvdDestripe
    | RepairDeadPixels,
    Field(discriminator="filter"),
]


FILTER_SECTIONS: tuple[type[Section], ...] = get_args(get_args(Filter)[0])
"""The section of every filter."""


class ShutterConfig(Section):
    """When the stream shows that the camera's shutter is closed."""

    enabled: bool = Field(True, description="look for closures; off for cameras without a shutter")
    gap_periods: float = Field(4.0, gt=1, description="frame periods; a longer gap between stamps counts as a closure when the stream runs evenly")
    max_jitter: float = Field(0.3, gt=0, description="relative spread of the period above which gaps say nothing (photo flights)")
    longest_s: float = Field(5.0, gt=0, description="seconds after which images of nothing but noise are a bare wall, no shutter; FLIR's cores take 0.25 to 1 s")


class PreprocessingConfig(Section):
    """Raw image to the 8-bit image the network sees; filters run in the order given."""

    filters: tuple[Filter, ...] = Field((ChambolleTv(weight=1.0, unit="noise"), HistogramClip(), Median()), description="in order; paper: total variation with 4 grey levels, histogram, median; of a faint image that takes half the right matches (measured)")
    window_s: float = Field(0.0, ge=0, description="seconds; time constant with which the 8-bit window of he_clip and stretch follows the frames; 0: each frame has its own, as in the paper")
    shutter: ShutterConfig = ShutterConfig()


# ---- front end (paper Sec. III-A) -------------------------------------------------------------------------------------------------


class ExtractorConfig(Section):
    """Keypoint detector and descriptor."""

    name: Literal["superpoint", "aliked", "aliked-n16rot", "xfeat", "sift", "orb"] = Field("aliked", description="paper: superpoint; aliked-n16rot where the camera rolls")
    max_keypoints: int = Field(1024, ge=32, le=8192, description="keypoints a frame at the most, the strongest")
    detection_threshold: float = Field(0.0, ge=0, description="least score; 0: the strongest max_keypoints, whatever their score (measured: SuperPoint's own 0.0005 finds too few on thermal frames)")
    nms_radius: int | None = Field(None, ge=1, le=32, description="px; none: what the network was published with (superpoint 4, aliked 2, xfeat 2); sift and orb have their own")
    crowding: float = Field(1.0, ge=0, description="most keypoints of an image cell over its even share, as long as other cells have any; 0: the strongest wherever they are, as in the paper (measured)")
    border: int = Field(4, ge=0, le=64, description="px at the image's edge without keypoints")
    corners: int = Field(0, ge=0, le=8192, description="xfeat: so many keypoints may be corners of the whole image, before those that the network detects, which it describes alike; what is followed is placed exactly at a corner, and slides along an edge (measured)")
    subpixel: bool = Field(True, description="superpoint: move keypoints from the whole pixel to the centre of mass of the 3x3 scores; measured: median epipolar error 9, 5 and 1 % less on three sequences; the paper's network gives whole pixels")
    long_side: int | None = Field(None, ge=128, description="px; images are scaled so that the long side has this length before detection; none: as they are")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:0, ...")
    backend: Literal["torch", "auto", "onnxruntime", "openvino"] = Field("torch", description="what computes the network of xfeat on a CPU; auto: the fastest that is installed; the others are always computed by torch")


class MatcherConfig(Section):
    """Learned or nearest-neighbour matching."""

    name: Literal["auto", "lightglue", "lighterglue", "nearest"] = Field("auto", description="auto: the learned matcher of the extractor, nearest for sift and orb")
    threshold: float = Field(0.1, ge=0, le=1, description="least confidence of a learned match; LightGlue's default")
    depth_confidence: float = Field(0.95, ge=-1, le=1, description="LightGlue's early exit; -1: off")
    width_confidence: float = Field(0.99, ge=-1, le=1, description="LightGlue's pruning; -1: off")
    ratio: float = Field(0.85, gt=0, le=1, description="nearest neighbour over second nearest; Lowe 2004 uses 0.8")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:0, ...")


class FlowConfig(Section):
    """Following keypoints from frame to frame instead of detecting in each."""

    enabled: bool = Field(False, description="detect on keyframes and where following fails, follow by Lucas-Kanade in between; off: detect in every frame, as in the paper")
    window: int = Field(15, ge=5, le=61, description="px; side of the square that is followed (measured: 21 takes 1.3 times as long and keeps 2 to 4 % more points)")
    levels: int = Field(3, ge=0, le=8, description="halvings of the image; the first shift is known, and a fourth takes 1 ms more and finds no more points (measured)")
    max_back_px: float = Field(1.0, gt=0, description="px by which a point followed there and back may miss where it came from")
    patch: int = Field(15, ge=5, le=31, description="px; side of the square whose look is compared before and after")
    min_similarity: float = Field(0.7, ge=-1, le=1, description="least zero-mean normalized cross-correlation of the squares")
    exact_similarity: float = Field(0.9, ge=-1, le=1, description="least correlation of the square as it was detected, laid over an image by an affine map, for the point to be where that lies; with less it is where the step from the last image has led")
    max_exact_px: float = Field(2.0, gt=0, description="px that this may lie from the step")
    worn_similarity: float = Field(0.5, ge=-1, le=1, description="the same below which a point is followed no longer when new ones are detected")
    border: int = Field(4, ge=0, le=64, description="px at the image's edge where nothing is followed")
    max_points: int = Field(350, ge=32, le=8192, description="keypoints that are followed at the most; what is detected beyond is there to be matched when the camera is lost, and for places")
    min_points: int = Field(80, ge=8, description="points below which new ones are detected")
    min_share: float = Field(0.4, ge=0, le=1, description="the same, as a share of the points after the last detection")
    far_share: float = Field(0.5, ge=0, le=1, description="share of one frame's points found in the next below which they are sought with more effort: after missing frames, a closed shutter, a quick turn (video finds 0.8 to 0.95 at once, measured)")
    near_px: float = Field(4.0, gt=0, description="px around a followed point in which a detection is the same point")
    min_shared: int = Field(50, ge=8, description="tracks that two frames must share for these to be all their matches; where they share fewer, those of the matcher are added")


# ---- the method (paper Sec. III-C, III-D) -----------------------------------------------------------------------------------------


class InitializationConfig(Section):
    """First map: reference frame, models, and what a map must show before it is claimed."""

    min_matches: int = Field(50, ge=8, description="matches to the reference frame that a start needs; thermal frames give fewer points than visible ones; ORB-SLAM3: 100")
    max_starved_frames: int = Field(2, ge=0, description="frames in a row with fewer matches after which the reference frame advances")
    max_gap_frames: int = Field(30, ge=2, description="frames after which the reference advances in any case")
    min_points: int = Field(50, ge=8, description="triangulated points of a map; ORB-SLAM3: 50")
    min_parallax_deg: float = Field(1.0, gt=0, description="degrees, median over the map's points; ORB-SLAM3: 1")
    max_reprojection_px: float = Field(2.0, gt=0, description="px; ORB-SLAM3: 2 (4 sigma^2)")
    magsac_threshold_px: float = Field(1.0, gt=0, description="px")
    min_parallax_to_noise: float = Field(3.0, ge=1, description="residual of the best pure rotation over what the matches' noise alone would leave, for many matches; more is asked of few; a camera that only turns gives 1 to 2.9 (measured)")
    min_inlier_ratio: float = Field(0.5, ge=0, le=1, description="share of the matches that the first map must explain")
    ambiguity_ratio: float = Field(1.3, ge=1, description="least cost of the second-best motion hypothesis over the best; below it the start waits (plane seen by few views)")
    probation_frames: int = Field(3, ge=0, description="frames that must be tracked in a new map before a pose in it is claimed; a map that fails one is dropped; 0: claimed at once")
    between_views: int = Field(3, ge=0, le=10, description="frames between reference and current that take part in the first bundle adjustment and tell a plane's two motions apart")


class TrackingConfig(Section):
    """Two-stage tracking."""

    match_by: Literal["matcher", "nearest"] = Field("matcher", description="how frames are matched: by the configured matcher, or by nearest descriptors, which takes a fifteenth of LighterGlue's time (measured); mapping matches by the configured one")
    min_reference_matches: int = Field(15, ge=4, description="matches that see a landmark; ORB-SLAM3: 15")
    min_reference_inliers: int = Field(10, ge=4, description="ORB-SLAM3: 10")
    min_inliers: int = Field(25, ge=6, description="inliers after the second stage; ORB-SLAM3: 30, thermal frames have fewer points")
    min_visible_share: float = Field(0.15, ge=0, le=1, description="landmarks that agree over those that should be seen from there, of the keyframe that shares most with a frame; where the view jumps to another street 0.11 agree, where tracking goes on 0.25 to 0.8 (measured)")
    min_sparse_landmarks: int = Field(8, ge=4, description="landmarks that suffice where matches without landmarks agree with the pose: they give what those leave open, the scale")
    min_sparse_matches: int = Field(50, ge=10, description="matches without landmarks, and at least half of all, that must agree with such a pose")
    local_keyframes: int = Field(20, ge=1, description="keyframes whose landmarks are projected")
    max_view_angle_deg: float = Field(60.0, gt=0, lt=180, description="degrees; paper: 60")
    depth_margin: float = Field(2.0, ge=1, description="a landmark is looked for between its least observed distance over this and its largest times this; the detectors have no octaves")
    search_radius_px: float = Field(4.0, gt=0, description="px; ORB-SLAM3: 2.5 to 4 px")
    wide_search_radius_px: float = Field(12.0, gt=0, description="px; when only the motion model gave the first pose")
    min_descriptor_similarity: float = Field(0.75, ge=-1, le=1, description="cosine of float descriptors; 1 - 2 * Hamming share of binary ones")
    descriptor_ratio: float = Field(0.9, gt=0, le=1, description="best over second-best descriptor distance among candidates")
    chi2_px2: float = Field(5.991, gt=0, description="px^2; 95 % of chi-square with 2 degrees of freedom at 1 px")
    mask_fixed_pattern: bool = Field(True, description="learn where keypoints stay on one pixel while the image moves, and use none there")


class KeyframeConfig(Section):
    """When a frame becomes a keyframe (paper Sec. III-C)."""

    rotation_deg: float = Field(15.0, gt=0, description="degrees since the last keyframe; paper: 15")
    translation_ratio: float = Field(0.03, gt=0, description="displacement over median depth; paper: 0.03")
    min_tracked_ratio: float = Field(0.5, ge=0, le=1, description="landmarks tracked over those of the reference keyframe; below it a keyframe is due; 0: off, as in the paper")
    most_pending: int = Field(2, ge=1, description="keyframes that wait for mapping, where it runs in a process of its own; none is made while so many do")


class MappingConfig(Section):
    """Growing and cleaning the map."""

    covisibility_threshold: int = Field(15, ge=1, description="shared landmarks that make an edge; ORB-SLAM3: 15")
    neighbours: int = Field(3, ge=1, le=30, description="covisible keyframes that a new keyframe is matched to, its reference among them; ORB-SLAM3: 30, with learned matching each but the reference costs a network run")
    chained_keyframes: int = Field(10, ge=0, description="keyframes that a new one is matched to through a common neighbour, without the network")
    good_baseline_ratio: float = Field(0.1, ge=0, description="distance to a neighbour over median depth from which its baseline counts in full when neighbours are chosen")
    epipolar_px: float = Field(2.0, gt=0, description="px to the epipolar line; chi-square 3.84 at 1 px is 1.96 px")
    min_parallax_deg: float = Field(1.0, gt=0, description="degrees between the rays of a new point; ORB-SLAM3: 1.15; with 0.25 a photo flight under the literal weights goes wrong (measured)")
    max_reprojection_px: float = Field(2.0, gt=0, description="px")
    max_scale_ratio: float = Field(4.0, gt=1, description="distance of a new point in one view over that in the other")
    min_found_ratio: float = Field(0.25, ge=0, le=1, description="found / predicted visible below which a landmark is culled; paper: 25 %")
    trial_keyframes: int = Field(3, ge=1, description="keyframes after which a landmark must have trial_observations; ORB-SLAM3: 3")
    redundant_share: float = Field(0.9, gt=0, le=1, description="share of a keyframe's landmarks that redundant_observers others must see from about as near for it to leave; ORB-SLAM3: 0.9")
    redundant_observers: int = Field(3, ge=2, description="ORB-SLAM3: 3")
    redundant_from: int = Field(500, ge=2, description="keyframes of a map from which on redundant ones leave; from 20 on it spares 4 % of them on a corridor loop and costs 10 % of the accuracy (measured)")
    max_keyframes: int = Field(3000, ge=10, description="keyframes of a map beyond which the most redundant ones leave in any case; about 1 MB each")
    trial_observations: int = Field(3, ge=2, description="observations a landmark must have by then; ORB-SLAM3: 3")


class BundleConfig(Section):
    """Local and full bundle adjustment."""

    local_keyframes: int = Field(20, ge=2, description="keyframes optimised with the new one; a window of 12 drifts more in scale where keyframes follow each other closely (measured)")
    fixed_keyframes: int = Field(20, ge=1, description="outer keyframes kept fixed at the most")
    iterations: int = Field(10, ge=1, description="Levenberg-Marquardt steps a stage")
    local_solver: Literal["gtsam", "schur"] = Field("gtsam", description="of local adjustments; schur: compiled, dense in the keyframes, a fraction of the time")
    tolerance: float = Field(1e-4, gt=0, description="a step that lessens the cost by a smaller share ends a stage of a local adjustment")
    full_iterations: int = Field(30, ge=1, description="steps of the full adjustment at the end")
    full_tolerance: float = Field(1e-5, gt=0, description="the same of the full adjustment")
    huber_px: float = Field(2.447, gt=0, description="px; sqrt(5.991)")
    chi2_px2: float = Field(5.991, gt=0, description="px^2; observations beyond are outliers")
    landmark_freedom: float = Field(0.0, ge=0, description="degrees of freedom of the Student t distribution by which the errors of a landmark weigh all of its observations; 0: all landmarks alike, as in the paper")


class RelocalizationConfig(Section):
    """What happens after tracking is lost."""

    keyframes: int = Field(3, ge=1, description="keyframes that a lost frame is matched to: at first the last ones, then those of the whole map that look most alike")
    search_keyframes: int = Field(6, ge=1, description="the same after a shutter closure")
    search_frames: int = Field(5, ge=0, description="frames after a closure that are matched to so many before tracking counts as lost")
    min_inliers: int = Field(30, ge=6, description="inliers of an accepted relocalisation")
    min_visible_share: float = Field(0.2, ge=0, le=1, description="landmarks that agree over those that should be seen from there, of the keyframe that shares most with a lost frame; where another street only looks like it 0.03 to 0.16 agree, at the right place 0.19 to 0.68 (measured)")
    remembered_frames: int = Field(150, ge=0, description="frames without a pose whose features are kept, to be placed in the map afterwards")
    new_map_after_frames: int = Field(5, ge=1, description="frames lost before a new map is begun beside the old one")


class LoopConfig(Section):
    """Places that are seen again, and what that does to the map."""

    enabled: bool = Field(True, description="close loops; the paper does not")
    vocabulary_keyframes: int = Field(5, ge=1, description="first keyframes of a map, of whose descriptors the words are made")
    words: int = Field(64, ge=4, description="words of the vocabulary")
    similarity_share: float = Field(0.8, gt=0, description="of the similarity to keyframes that see the same: what a candidate must look alike")
    group: int = Field(3, ge=1, description="keyframes of the old place that the new one is matched to: the candidate and its best neighbours")
    min_nearest: int = Field(0, ge=0, description="landmarks of the candidate that must agree with one pose of the new keyframe by nearest descriptors (0.9 of the distance to the second), before a network is asked; 0: it always is. Of such descriptors with landmarks XFeat gives 52 to 194 at places seen again, 4 to 49 at what looks alike, most of which no one pose explains (`thegra.log` of five recordings with 1000)")
    min_matches: int = Field(40, ge=6, description="matches to the candidate alone")
    min_inliers: int = Field(40, ge=6, description="landmarks of the old place that must agree with one pose of the new keyframe")
    min_visible_share: float = Field(0.2, ge=0, le=1, description="these over the landmarks of the old place that should be seen from there; where a building only repeats itself 0.05 to 0.18 agree; at a place seen again 0.09 to 0.34, so that a loop may wait for a better view (measured)")
    max_drift_deg: float = Field(20.0, gt=0, description="degrees by which a loop may turn the newest keyframe: corridors that look alike at another heading turn it by 90, a place seen again by 1 to 4 (measured)")
    max_drift_ratio: float = Field(0.2, gt=0, description="distance by which a loop may move the newest keyframe, over the way since the old place, and more where the scale has drifted; corridors that look alike move it by 0.84 and more, a place seen again by 0.01 to 0.02 (measured)")
    min_scale_pairs: int = Field(10, ge=3, description="landmarks of both places that are the same points: they tell the scale")
    max_scale_spread: float = Field(0.1, gt=0, description="median deviation of the logarithm of their depths' ratio")
    max_rotation_deg: float = Field(3.0, gt=0, description="degrees by which a second keyframe may place the loop otherwise")
    max_translation_ratio: float = Field(0.1, gt=0, description="the same in position, over the median depth")
    rotations: tuple[Literal[90, 180, 270], ...] = Field((), description="degrees by which the image of a frame that is not found is turned, and from when on all are where a tracked camera has rolled: for cameras that look at the ground and turn; each costs an extraction and the matches of a frame that is not found, until a new map may begin")
    full_adjustment_after: int = Field(3, ge=1, description="keyframes after a loop or a merge from which on the result of the full adjustment is taken")


class ThegraConfig(Section):
    """The whole configuration; `config.yaml` of a run holds exactly this."""

    profile: str = Field("quality", description="the profile the values started from")
    seed: int = Field(0, ge=0, description="of every random choice")
    threads: int = Field(0, ge=0, description="CPU threads of the networks, unless OMP_NUM_THREADS says otherwise; 0: one a core, 4 at most, as a lost camera is sought with in any case")
    weighting: Literal["normalized", "paper", "uniform"] = Field("normalized", description="observation weights from detection scores: over the keyframe's median; the literal score squared (paper Eq. 1); none")
    preprocessing: PreprocessingConfig = PreprocessingConfig()
    extractor: ExtractorConfig = ExtractorConfig()
    matcher: MatcherConfig = MatcherConfig()
    flow: FlowConfig = FlowConfig()
    initialization: InitializationConfig = InitializationConfig()
    tracking: TrackingConfig = TrackingConfig()
    keyframe: KeyframeConfig = KeyframeConfig()
    mapping: MappingConfig = MappingConfig()
    bundle: BundleConfig = BundleConfig()
    loop: LoopConfig = LoopConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()


def load_config(
    profile: str | None = None, file: Path | None = None, overrides: dict[str, Any] | None = None, default: str = "quality"
) -> ThegraConfig:
    """Profile, then file, then dotted overrides such as {"extractor.max_keypoints": "2048"}; later ones win.

    A file may name the profile it builds on (`profile: fast`); `profile` given here wins over it, and `default` holds where neither names one.

    Raises:
        ConfigError: Naming the key and what it takes.
    """
    from_file = _read_yaml(file) if file is not None else {}
    name = profile or from_file.get("profile") or default
    values = _merge(_profile_values(str(name)), from_file)
    values["profile"] = name
    for key, value in (overrides or {}).items():
        _set_dotted(values, key, yaml.safe_load(value) if isinstance(value, str) else value)
    try:
        return ThegraConfig.model_validate(values)
    except ValidationError as error:
        lines = [f"  {'.'.join(str(part) for part in e['loc'])}: {e['msg']} (got {e['input']!r})" for e in error.errors()]
        raise ConfigError("configuration not understood:\n" + "\n".join(lines) + "\nlist the parameters with: thegra config") from error


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """Overrides for `load_config` from `KEY=VALUE` texts, as the options `--set` take them.

    Raises:
        ConfigError: If one is of another form.
    """
    overrides: dict[str, Any] = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set {assignment}: write KEY=VALUE, e.g. --set extractor.max_keypoints=2048; the keys are listed by: thegra config")
        overrides[key.strip()] = value
    return overrides


def dump_config(config: ThegraConfig) -> str:
    """The configuration as YAML that `load_config` reads back to an equal one."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def _profile_values(name: str) -> dict[str, Any]:
    if name not in PROFILES:
        raise ConfigError(f"unknown profile {name!r}; known: {', '.join(PROFILES)}")
    text = importlib.resources.files("thegra_core").joinpath(f"profiles/{name}.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text) or {}


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{file} is not YAML: {error}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{file} holds no key: value pairs at its top level")
    return {key: value for key, value in values.items() if key != RUN_FACTS}


def _merge(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in top.items():
        merged[key] = _merge(merged[key], value) if isinstance(value, dict) and isinstance(merged.get(key), dict) else value
    return merged


def _set_dotted(values: dict[str, Any], key: str, value: Any) -> None:
    *parents, last = key.split(".")
    for parent in parents:
        child = values.setdefault(parent, {})
        if not isinstance(child, dict):
            raise ConfigError(f"--set {key}: {parent} is no section")
        values = child
    values[last] = value
