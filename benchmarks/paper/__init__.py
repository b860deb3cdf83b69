"""The paper's experiments, from training to the page of results.

`python -m benchmarks.paper --preset smoke|cpu|full` trains and deploys what is missing,
then writes the pages. Everything measured lies in parquet files with their provenance
(`store`); figures, tables and pages are made from those alone.

* `cells`: what is trained; `columns`: where it is deployed; `work`: the loop over both.
* `training`, `deployment`, `failures`, `pictures`: how the store is filled.
* `measures`, `targets`, `published`, `tables`: the numbers; `figures`, `page`,
  `report`: the pages.
"""
