"""Example-based relief synthesis: texture synthesis directly on a mesh.

exemplar (height above the style's own smooth shape) ──► bank of patches, level by level
source ──► direction field ──► a grid of samples around every vertex
nearest patch for every grid, each vertex the mean of the patches' votes   (repeated)

No network and no renderer. After Turk (2001), Wei and Levoy (2001), Kwatra et al. (2005), Lefebvre
and Hoppe (2006) and Kopf et al. (2007); see docs/synthesis.md.
"""
