"""Moving pictures of a trial: an MP4, without a window."""

from kraft.video.recorder import VideoRecorder, check_video

__all__ = ["VideoRecorder", "check_video"]
