"""Findings of readers: what they left out, assumed or changed."""

from jaxnav.kinds.kind import INFO, Kind

KINDS: dict[str, Kind] = {
    "rows.bad": Kind(INFO, "{subject}: {count} of {of} rows {why} are left out, the first at {at}"),
    "rows.no_value": Kind(INFO, "{subject}: {count} of {of} rows have no value, or a mark for none, and are left out"),
    "rows.no_sd": Kind(INFO, "{subject}: {count} of {of} rows without a usable sd are left out"),
    "rows.some_sd": Kind(INFO, "{subject}: {count} of {of} rows state no sd on an axis; assumed there are {words}"),
    "rows.no_height": Kind(
        INFO,
        "{subject}: {count} of {of} rows have no height, or a mark for none: it is {words}, with an sd of {limit:g} m",
    ),
    "rows.outside": Kind(INFO, "{subject}: {count} of {of} rows are before the IMU's first sample or after its last"),
    "rows.far": Kind(
        INFO,
        "{subject}: {count} of {of} rows are farther from the others than {limit:g} m/s allow and are left "
        "out, the first at {at:.1f} s",
    ),
    "rows.alike": Kind(INFO, "{subject}: {value:.0f} % of the rows repeat the row before: standing, or polled?"),
    "rows.repeated": Kind(
        INFO,
        "{subject}: {count} of {of} rows repeat the row before: the logger may have polled the sensor",
    ),
    "rows.piece": Kind(INFO, "{subject}: {count} rows that are more than an hour from the rest are left out"),
    "imu.mended": Kind(
        INFO,
        "{subject}: {count} repeated rows are taken out and {lost} lost samples filled in; the sensor's "
        "clock gives one every {value:.5g} ms",
    ),
    "imu.unmended": Kind(INFO, "{subject}: it has gaps, so that its repeated rows are not mended"),
    "imu.holes": Kind(INFO, "The IMU has {words}, the longest {value:.3g} s long, {at:.1f} s after its start"),
    "imu.seldom": Kind(INFO, "The IMU comes at {value:.3g} Hz: strapdown navigation loses the motion in between"),
    "imu.upright": Kind(
        INFO,
        "The mean specific force is ({vector}) m/s^2, where FRD at rest reads (0, 0, -9.8): {words}",
    ),
    "imu.two_clocks": Kind(
        INFO,
        "{subject}: accelerations interpolated from times {words}: {count} of {of} gyro samples have one",
    ),
    "velocity.none": Kind(INFO, "There is no velocity: position only"),
    "time.zero": Kind(INFO, "t = 0 is {words}"),
    "time.week": Kind(
        INFO,
        "{subject}: its times are {value:+g} weeks from the IMU's, and are taken for the same week",
    ),
    "time.since_1970": Kind(
        INFO,
        "{subject}: times since 1970 are taken as seconds of GPS week {value:.0f}, the IMU's time scale",
    ),
    "time.utc": Kind(
        INFO, "{subject}: UTC is taken as GPS time less {value:g} s, the leap seconds of its date{words}", unit="s"
    ),
    "time.undecided": Kind(
        INFO,
        "{subject}: its stamps may be UTC, {value:g} s behind the fixes' GPS time, which this motion does not decide: "
        'time_scale = "utc" or "gps" states it',
        unit="s",
    ),
    "imu.negated": Kind(INFO, "{subject}: the sign of an iPhone's accelerations is changed to specific force"),
    "axes.assumed": Kind(INFO, "{subject} is assumed {words} (option axes)"),
    "clock.repeats": Kind(INFO, "{subject} repeats in {count} of {of} fixes"),
    "clock.jumps": Kind(INFO, "GPS time jumps against board time {count} time(s), first by {words}"),
    "clock.rate": Kind(
        INFO,
        "board time runs at {value:.5f} of the rate of GPS time: all times are rescaled to GPS time",
    ),
    "clock.wraps": Kind(
        INFO,
        "{subject}: times fall by {value:.10g} s, {words}, where the counter wraps: they go on; streams "
        "begin within the same count",
    ),
    "clock.restarts": Kind(
        INFO,
        "{subject}: its clock starts again {count} times, in parts of {words}: part {part} is read (option part)",
    ),
    "clock.bridged": Kind(
        INFO,
        "{subject}: its stamps count from start-up, others from 1970: the times of reception bridge the clocks "
        "(within {value:.3f} s)",
        unit="s",
    ),
    "time.by_message": Kind(
        INFO, "{subject} is dated by the messages that bring it{words}: a delay of {value:g} s is usual", unit="s"
    ),
    "fixes.with_ins": Kind(INFO, "{subject}: {count} of {of} positions are made with the INS: {words}"),
    "fixes.none": Kind(INFO, "{count} {words} have no fix in three dimensions"),
    "heights.sea_level": Kind(INFO, "heights of fixes are above sea level, not above the ellipsoid"),
    "truth.no_height": Kind(INFO, "The simulator's truth has no height: 0 m stands in its place"),
    "truth.fused": Kind(
        INFO,
        "position, velocity and truth are all the unit's INS/GNSS solution: errors against this truth do not measure "
        "accuracy (fixes of a receiver: option gnss)",
    ),
    "range.satellites": Kind(INFO, "{subject}: {low} to {high}, {value:g} in the median, in {count} epochs"),
    "range.clock": Kind(
        INFO, "{subject}: the receiver's clock is taken out, {value:.0f} m, {rate:.1f} m/s{words}", unit="m"
    ),
    "range_rate.phase": Kind(
        INFO,
        "{subject}: carrier phase over {over:g} s, none in {lost:.1f} % of the rows (lock lost); as old as half of "
        "that: set measurements.range_rate.latency_s = {value:g}",
        unit="s",
    ),
    "stream.chosen": Kind(INFO, "{subject} is {words}"),
    "position.none": Kind(INFO, "{subject}: {words}"),
    "receiver.chosen": Kind(INFO, "position is {subject} with {count} fixes, of {words} (option receiver)"),
    "file.damaged": Kind(INFO, "{count} {words} are damaged and left out"),
    "file.cut": Kind(INFO, "{subject}: the last line has no line end and is left out: it may have been cut"),
    "file.lines": Kind(INFO, "{subject}: {count} lines {why} left out, first line {at}"),
    "file.header": Kind(INFO, "{subject}: {count} lines before the header are left out"),
    "file.units": Kind(INFO, "{subject}: the line of units below the header is left out"),
    "file.commas": Kind(INFO, "{subject}: commas are taken for decimal points"),
    "file.other": Kind(INFO, "{subject} is not read{words}"),
    "file.left_out": Kind(INFO, "{subject}: {count} {words} are left out"),
    "file.partly": Kind(INFO, "{subject} is cut or damaged{words}: its readable part is read"),
    "file.unchecked": Kind(INFO, "{count} {words} have no checksum and are {done}"),
    "log.dropouts": Kind(INFO, "The logger dropped data {count} times, {value:.1f} s in all", unit="s"),
    "columns.taken": Kind(
        INFO,
        "{subject}: columns are read as their names and numbers say: jaxnav map shows it, and drafts a map to change",
    ),
}
