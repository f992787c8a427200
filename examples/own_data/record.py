"""Turns the tables of a tracker and of a robot, in millimetres, into recordings."""

import csv

from livedeform.recording import Writer


def rows(name):
    with open(name) as file:
        return list(csv.DictReader(file))


for day, date in (("monday", "2026-03-02 10:30"), ("tuesday", "2026-03-03 09:00")):
    with Writer(f"{day}.mcap", begins=date) as recording:
        points = rows(f"{day}_points.csv")
        for second in dict.fromkeys(row["seconds"] for row in points):
            seen = [row for row in points if row["seconds"] == second]
            places = [[float(row[axis]) / 1000 for axis in "xyz"] for row in seen]
            recording.points(float(second), [int(row["id"]) for row in seen], places, sigma=0.0001)
        for row in rows(f"{day}_probe.csv"):
            place = [float(row[axis]) / 1000 for axis in "xyz"]
            recording.pose(float(row["seconds"]), place, [float(row["q" + axis]) for axis in "xyzw"])
