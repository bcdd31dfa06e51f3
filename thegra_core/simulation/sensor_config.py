"""Parameters of the simulated thermal camera, each with unit, range and where the value comes from."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SensorConfig(BaseModel):
    """An uncooled microbolometer camera. Defaults are those of a 640x512 core of the FLIR A65, Tau 2 or Boson kind indoors."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    optics_blur_px: float = Field(0.6, ge=0, le=5, description="px; standard deviation of the lens's blur. Diffraction at f/1.0 and 10 um on 12-17 um pixels, and the pixel's own area")
    time_constant_ms: float = Field(10.0, ge=0, le=30, description="ms; how fast a pixel's temperature follows (exponential). Data sheets: 8-12")
    row_time_us: float = Field(0.0, ge=0, le=100, description="us a row; rolling readout, the middle row at the stamp. 0: all rows at once. FLIR ADK: 27.8")
    counts_per_kelvin: float = Field(40.0, gt=0, le=200, description="counts/K; FLIR A65 raw 43-58, Tau 2 a few tens, radiometric Lepton 100")
    reference_k: float = Field(293.15, gt=0, description="K; temperature that reads as reference_counts")
    reference_counts: float = Field(7000.0, ge=0, le=65535, description="counts; middle of a 14-bit range")
    bits: int = Field(14, ge=8, le=16, description="bits of the raw output, which clips at both ends. Tau 2: 14")
    netd_mk: float = Field(50.0, ge=0, le=500, description="mK; temporal noise of a pixel, standard deviation. Data sheets at f/1.0: 40 (Boson) to 60")
    pattern_netd: float = Field(0.4, ge=0, le=5, description="times the NETD; fixed pattern of single pixels that is left after a flat-field correction. D'Agostino and Webb's VH term; assumed 0.3-0.5")
    column_netd: float = Field(0.35, ge=0, le=5, description="times the NETD; fixed column stripes after a correction (the H term); assumed 0.2-0.5")
    pattern_growth: float = Field(0.6, ge=0, le=20, description="times the NETD a minute; how both grow between corrections. Assumed: 1-3 after three minutes")
    pattern_time_s: float = Field(30.0, gt=0, description="s; correlation time of the growing pattern (knots every 30 s in TRGS-SLAM's model)")
    offset_drift_k: float = Field(0.15, ge=0, le=5, description="K a square root minute; random walk of the whole image's level. Assumed: 0.1-1 K a minute while warming up")
    dome_k_per_min: float = Field(0.1, ge=-5, le=5, description="K a minute since the last correction; corners against the middle (the lens's own heat). Assumed")
    offset_jump_k: float = Field(0.4, ge=0, le=5, description="K; step of the level at a correction, standard deviation. Assumed 0.1-1")
    dead_pixels: float = Field(0.0003, ge=0, le=0.05, description="share of pixels that are stuck at one value. Makers allow up to 0.01 before replacement")
    closure_period_s: float = Field(180.0, gt=0, description="s between corrections. Lepton: 3 min; Tau 2: settable. A shorter recording has one, in its middle")
    closure_s: float = Field(0.9, ge=0.05, le=5, description="s that the shutter stays closed. Tau 2 measured 0.94, Lepton 0.9")
    frame_drop: float = Field(0.0, ge=0, le=0.5, description="share of frames that are lost on the way, at random")
    stamp_jitter_us: float = Field(0.0, ge=0, le=20000, description="us; noise of the stamps, standard deviation")
    agc: Literal["off", "linear", "plateau"] = Field("off", description="off: raw counts. linear, plateau: 8 bit as the core's automatic gain control makes it")
    agc_time_s: float = Field(1.0, ge=0, description="s; how slowly the automatic gain follows the scene. Assumed")
    agc_tail: float = Field(0.01, ge=0, lt=0.5, description="share of pixels that the linear gain clips at each end")
    agc_plateau: float = Field(0.02, gt=0, le=1, description="share of pixels a histogram bin counts for at the most (plateau equalisation)")
