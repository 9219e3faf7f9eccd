"""Unidirectional edge sampling [LADL18]: silhouette edges as the vertices of a camera path see them."""
