"""Moving pictures of a trial: an MP4, or a window in real time."""

from kraft.video.recorder import VideoRecorder, check_video
from kraft.video.viewer import LiveView, check_view

__all__ = ["LiveView", "VideoRecorder", "check_video", "check_view"]
