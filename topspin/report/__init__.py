"""The report: results of runs, as a page with tables and plots, beside the paper's results.

``topspin report RUN...`` plays each run's policy on the same fixed rallies, groups runs that
differ only in their seed, and writes report.md, report.html, results.json and the plots.

==============  ==============================================================================
``config``      settings
``collect``     run folders -> values: settings, curves, policy
``groups``      groups runs into experiments, and names them
``provenance``  commands, versions, machine
``results``     plays the policies, measures, and holds every number, as results.json does
``tables``      results -> tables
``figures``     results -> plots (matplotlib)
``page``        tables and plots -> report.md and report.html (``page.html.j2``, jinja2)
``command``     the command line
==============  ==============================================================================

matplotlib and jinja2 come with ``pip install -e '.[report]'``.
"""
