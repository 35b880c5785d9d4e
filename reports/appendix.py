# %% [markdown]
# # All runs, for an appendix
#
# Every experiment below the folder: how many runs there are, their numbers with mean and standard
# deviation over seeds and pairs, and what they were made with. With `tables`, all as CSV and LaTeX.

# %% tags=["parameters"]
folder = "outputs/paper"
tables = None  # a folder for the tables as CSV and LaTeX

# %%
import pandas
from IPython.display import Markdown, display

from styleexp.experiments.reports import notebook as nb

runs = nb.runs(folder)
runs["experiment"] = [path.parent.name for path in runs["path"]]
Markdown(nb.caution(runs))

# %% [markdown]
# ## How many runs there are

# %%
counts = pandas.crosstab(runs["experiment"], runs["status"]).reset_index()
nb.save(counts, tables, "appendix_runs")
counts

# %% [markdown]
# ## Each experiment

# %%
metrics = [column for column in runs if column.startswith("metric.")]
for name, part in runs.groupby("experiment", sort=False):
    axes = [
        c
        for c in part
        if c.startswith("axis.") and c != "axis.optim.seed" and part[c].nunique() > 1
    ]
    measured = [c for c in ["loss", *metrics] if c in part and part[c].notna().any()]
    if not measured:
        continue
    by = part.groupby(axes or ["pair"], dropna=False, sort=False)
    table = by[measured].mean()
    table.insert(0, "runs", by.size())
    if by.size().max() > 1:
        judged = "metric.style_distance" if "metric.style_distance" in measured else measured[0]
        table[f"std of {judged.removeprefix('metric.')}"] = by[judged].std()
    table = table.reset_index()
    table.columns = [str(c).removeprefix("metric.").removeprefix("axis.") for c in table.columns]
    nb.save(table, tables, f"appendix_{name}")
    display(Markdown(f"### {name}"), table)

# %% [markdown]
# ## Made with

# %%
made = {
    column: ", ".join(map(str, runs[column].dropna().unique()))
    for column in runs
    if column.startswith("version.")
    or column in ("device", "config.encoder.name", "config.optim.steps")
}
made = pandas.DataFrame(made.items(), columns=["what", "which"])
nb.save(made, tables, "appendix_versions")
made
