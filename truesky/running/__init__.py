"""Run jobs, which make tables, with Spark: command line, session and worker processes, time and memory of tasks."""
