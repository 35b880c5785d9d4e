# %% [markdown]
# # What each switch between the paper's method and ours does (no figure)
#
# `styleexp +experiment=method_ablation`: `robust` with one choice at a time set back to the paper's, and
# `paper` as a whole. A difference is that of the switch from `robust`; below zero the switch is better
# where lower is better.

# %% tags=["parameters"]
folder = "outputs/method_ablation"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
from IPython.display import Markdown

from styleexp.experiments.reports import notebook as nb

runs = nb.runs(folder, "method_ablation")
runs["switch"] = runs.get("axis.switch", "robust")
Markdown(nb.caution(runs))

# %% [markdown]
# ## The figure

# %%
nb.pictures(runs.sort_values("switch"), "switch")

# %% [markdown]
# ## The numbers

# %%
metrics = ["style_distance", "relief_distance", "relief_rms", "silhouette_iou", "craft"]
shown = nb.table(runs, metrics)
nb.save(shown, tables, "method")
nb.show(shown)

# %%
import pandas

rows = []
for switch in runs["switch"].unique():
    row = {"switch": switch}
    for metric in metrics:
        row[metric] = nb.mean(runs, metric, switch=switch) - nb.mean(runs, metric, switch="robust")
    rows.append(row)
differences = pandas.DataFrame(rows).dropna(axis=1, how="all")
nb.save(differences, tables, "method_differences")
differences

# %% [markdown]
# ## What we say of it


# %%
def of(metric, switch):
    return switch, nb.mean(runs, metric, switch=switch)


nb.claims(
    nb.smaller(
        "(ours) robust comes nearer to the style than paper",
        of("style_distance", "robust"), of("style_distance", "paper"), "style distance",
    ),
    nb.smaller(
        "(ours) robust keeps the shape better than paper",
        of("silhouette_iou", "paper"), of("silhouette_iou", "robust"), "silhouette IoU with the source",
    ),
    nb.smaller(
        "(ours) robust is cleaner than paper",
        of("craft", "paper"), of("craft", "robust"), "craft, as raters would say",
    ),
)  # fmt: skip
