"""Images to points, by technique. Only images and a rig are known here."""
