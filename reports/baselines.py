# %% [markdown]
# # Compared with other methods (Figs. 5 and 6)
#
# `styleexp +experiment=baselines_mesh` and `baselines_image`. What each baseline is, and how far it is from
# its publication, is in `docs/baselines.md`. The numbers are measured in the same way for all methods.

# %% tags=["parameters"]
folder = "outputs/paper"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
from IPython.display import Markdown

from styleexp.experiments.reports import notebook as nb

runs = nb.runs(folder, "baselines_mesh", "baselines_image")
runs["method"] = runs.get("axis.method", "robust")
Markdown(nb.caution(runs))

# %% [markdown]
# ## The figure

# %%
nb.pictures(runs, "method")

# %% [markdown]
# ## The numbers

# %%
shown = nb.table(runs, ["style_distance", "relief_distance", "relief_rms", "silhouette_iou",
                        "self_intersections", "craft"])  # fmt: skip
nb.save(shown, tables, "baselines")
nb.show(shown)

# %%
nb.bars(runs, "method", ["style_distance", "silhouette_iou", "self_intersections"])

# %% [markdown]
# ## What the paper says of it
#
# The paper compares pictures by eye: clearer and more accurate styles than Text2Mesh's, styles from pictures
# where the GAN takes meshes only. Ours that learns is `robust`, the faithful one `paper`; `synthesis`, the
# default, is compared above.


# %%
def of(metric, method):
    return method, nb.mean(runs, metric, method=method)


OURS = ("robust", "paper", "synthesis", "not given")
others = [m for m in runs["method"].unique() if m not in OURS]
nb.claims(
    *(
        nb.smaller(
            f"the style is nearer than with {other}",
            of("style_distance", ours), of("style_distance", other), "style distance",
        )
        for other in others
        for ours in ("robust", "paper")
        if (runs["method"] == ours).any()
    )
)  # fmt: skip
