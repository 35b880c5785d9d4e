"""A relief laid on a surface by example: texture synthesis where the mesh is the canvas.

exemplar (height over the style's own smooth shape) ──► bank of patches, level by level
source ──► direction field ──► a grid of samples round every vertex
nearest patch for every grid, every vertex the mean of what the patches say of it   (repeated)

No network and no renderer. After Turk (2001), Wei and Levoy (2001), Kwatra et al. (2005), Lefebvre
and Hoppe (2006) and Kopf et al. (2007); see docs/synthesis.md.
"""
