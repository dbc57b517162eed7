"""Videos of a trial: an MP4 (`kraft.video.recorder`), or a window in real time (`kraft.video.viewer`)."""
