"""Run jobs: the command line of a job, the Spark session and its workers, time and memory of tasks."""
