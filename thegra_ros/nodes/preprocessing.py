"""Images in; pre-processed images and the shutter's state out. The node to run beside the camera where the rest runs elsewhere."""

from __future__ import annotations

import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool

from thegra_core.messages import Frame
from thegra_core.preprocessing.stage import PreprocessingStage
from thegra_ros.codec.images import image_message
from thegra_ros.codec.shutter import FrameNotice, notice_message
from thegra_ros.codec.stamps import header
from thegra_ros.image_input import ImageInput
from thegra_ros.lifecycle import run_node
from thegra_ros.qos import LOSSLESS, STREAM
from thegra_ros.stage_node import StageNode


class PreprocessingNode(StageNode):
    """The first stage."""

    def __init__(self, **options: Any) -> None:
        super().__init__("preprocessing", **options)
        self._input: ImageInput | None = None
        self.offer(SetBool, "~/pause", self._on_pause)

    def prepare(self) -> None:
        self._images = self.publisher(Image, "image_preprocessed", STREAM)
        self._notices = self.publisher(DiagnosticArray, "shutter", LOSSLESS)
        self._epoch = 0
        self._fresh()
        self._input = ImageInput(self, self.own.image_transport, self.health, lambda frame, frame_id: self.enqueue((frame, frame_id)), self._restart)

    def release(self) -> None:
        if self._input is not None:
            self._input.close()
        self._input = None
        super().release()

    def work(self, item: tuple[Frame, str]) -> None:
        frame, frame_id = item
        prepared = self._stage.process(frame)
        if prepared.shutter is None:
            self.health.is_of_no_use(prepared.trouble)
            return
        self._notices.publish(notice_message(FrameNotice(prepared.shutter, self._epoch, frame_id)))
        if prepared.image is not None:
            self._images.publish(image_message(header(frame.stamp_ns, frame_id), prepared.image))

    def begin_anew(self, why: str) -> None:
        self._fresh()

    def _on_pause(self, request: SetBool.Request) -> str:
        self.health.paused = bool(request.data)
        self.reporter.report()
        return "paused: images are ignored" if request.data else "images are worked on"

    def _restart(self, why: str) -> None:
        """In the order of the images: what waits is of the old run, what comes of the new one."""
        if self._input is not None:
            self._input.forget()
        if self.queue is not None:
            self.queue.clear()
        self.do_first(self._fresh)
        self.get_logger().info(f"the stream begins anew: {why}")

    def _fresh(self) -> None:
        self._epoch += 1
        self._stage = PreprocessingStage(self.config.preprocessing)


def main() -> None:
    """The executable `preprocessing`."""
    sys.exit(run_node(PreprocessingNode))


if __name__ == "__main__":
    main()
