# %% [markdown]
# # Which layers make the style (Fig. 8)
#
# The paper trains with VGG-19's layers 1-4 (low), with one from each block (mixed: 1, 3, 5, 9, 13) and
# with 10-14 (high). Here: `styleexp +experiment=layer_ablation`. Nothing below trains; it reads what the
# runs saved. The training loss of different layers can't be compared, so results are judged by
# `style_distance` (0 is the style, 1 the bare source) from an encoder that they were not trained with.

# %% tags=["parameters"]
folder = "outputs/layer_ablation"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
from IPython.display import Markdown

from styleexp.experiments.reports import notebook as nb

runs = nb.runs(folder, "layer_ablation")
runs["layers"] = (
    runs["axis.layers"].str.removesuffix("_vgg16") if "axis.layers" in runs else "mixed"
)
runs = runs.sort_values("layers", key=lambda column: column.map(["low", "mixed", "high"].index))
Markdown(nb.caution(runs))

# %% [markdown]
# ## The figure

# %%
nb.pictures(runs, "layers")

# %% [markdown]
# ## The numbers

# %%
shown = nb.table(
    runs, ["style_distance", "relief_distance", "relief_rms", "silhouette_iou", "chamfer"]
)
nb.save(shown, tables, "layer_ablation")
nb.show(shown)

# %%
nb.bars(runs, "layers", ["style_distance", "relief_rms", "silhouette_iou"])

# %% [markdown]
# ## What the paper says of it


# %%
def of(metric, layers):
    return layers, nb.mean(runs, metric, layers=layers)


nb.claims(
    nb.smaller(
        "with low layers the source is significantly distorted",
        of("silhouette_iou", "low"), of("silhouette_iou", "mixed"), "silhouette IoU with the source",
    ),
    nb.smaller(
        "with high layers the undulation of the surface is not clearly visible",
        of("relief_rms", "high"), of("relief_rms", "mixed"), "RMS height of the relief, in radii",
    ),
    nb.smaller(
        "mixed layers learn the style better than low ones",
        of("style_distance", "mixed"), of("style_distance", "low"), "style distance",
    ),
    nb.smaller(
        "mixed layers learn the style better than high ones",
        of("style_distance", "mixed"), of("style_distance", "high"), "style distance",
    ),
)  # fmt: skip
