"""Videos of a trial: an MP4, or a window in real time (`kraft.video.recorder`)."""

import kraft.matplotlib_folder  # noqa: F401  (before matplotlib)
