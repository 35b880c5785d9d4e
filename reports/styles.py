# %% [markdown]
# # Styles of meshes and pictures on several sources (Figs. 2, 3 and 4)
#
# `styleexp +experiment=mesh_styles`, `multi_style` and `image_styles`. `style_distance` is 0 for the style
# itself and 1 for the bare source, measured with an encoder that the runs were not trained with.

# %% tags=["parameters"]
folder = "outputs/paper"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
from IPython.display import Markdown, display

from styleexp.experiments.reports import notebook as nb
from styleexp.system.errors import UserError

runs = nb.runs(folder, "mesh_styles", "multi_style", "image_styles")
runs["source"] = runs["pair"].str.split("-").str[0]
runs["style"] = runs["pair"].str.split("-", n=1).str[1]
Markdown(nb.caution(runs))

# %% [markdown]
# ## The figures

# %%
for number, name in ((2, "mesh_styles"), (3, "multi_style"), (4, "image_styles")):
    try:
        part = nb.runs(folder, name)
    except UserError:
        continue  # no run of it here
    part["source"], part["style"] = (
        part["pair"].str.split("-", n=1).str[0],
        part["pair"].str.split("-", n=1).str[1],
    )
    display(Markdown(f"Fig. {number}, `{name}`:"), nb.pictures(part, "style", "source"))

# %% [markdown]
# ## The numbers

# %%
shown = nb.table(
    runs, ["style_distance", "relief_distance", "relief_rms", "silhouette_iou", "craft"]
)
nb.save(shown, tables, "styles")
nb.show(shown)

# %%
nb.bars(runs, "style", ["style_distance", "silhouette_iou"])

# %% [markdown]
# ## What the paper says of it

# %%
finished = runs[runs["status"] == "done"]
distances = finished.get("metric.style_distance")
kept = finished.get("metric.silhouette_iou")
nb.claims(
    nb.Claim(
        "the results take on the style of meshes and of pictures alike",
        "style distance not measured" if distances is None or distances.isna().all() else
        f"style distance below 1 for {(distances < 1).sum()} of {distances.notna().sum()} runs, "
        f"mean {distances.mean():.3g}, largest {distances.max():.3g}",
        None if distances is None or distances.isna().all() else bool((distances.dropna() < 1).all()),
    ),
    nb.Claim(
        "the shape of the source is kept (we take a silhouette IoU of 0.9 for kept)",
        "silhouettes not measured" if kept is None or kept.isna().all() else
        f"silhouette IoU with the source: mean {kept.mean():.3g}, least {kept.min():.3g}",
        None if kept is None or kept.isna().all() else bool((kept.dropna() > 0.9).all()),
    ),
)  # fmt: skip
