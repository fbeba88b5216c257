"""The same properties of every kind of camera, one a file, over the cameras of `cameras.CAMERAS`."""
