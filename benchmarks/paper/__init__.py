"""The paper's experiments, from training to the page of results.

`python -m benchmarks.paper --preset smoke|cpu|full` trains and deploys what is missing,
then writes the pages. Everything measured lies in parquet files with their provenance
(`store`); figures, tables and pages are made from those alone.

* `cells`: what is trained, and where it is deployed.
* `training`: the loop over both; with `deployment`, how the store is filled.
* `measures`, `targets`, `tables`: the numbers; `figures`, `front`, `page`, `report`:
  the pages.
"""
