"""KINDS: findings of a check, a run or a tuning, and their texts; numerics give the numbers.

A new kind is a row here. docs/findings.md lists them.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

from jaxnav.types import Finding, Severity

INFO, WARNING = Severity.INFO, Severity.WARNING


class Kind(NamedTuple):
    """A kind of finding; in its texts stand the numbers of `finding` by name."""

    severity: Severity
    message: str  # one sentence: quantity, value, limit
    causes: tuple[str, ...] = ()  # the likely ones first
    actions: tuple[str, ...] = ()  # settings or commands
    unit: str = ""  # of value and limit
    breaks_solution: bool = False  # as a warning: there is no right trajectory with it
    exceeds_sd: bool = False  # errors may be above the stated sd


KINDS: dict[str, Kind] = {
    # the IMU by itself
    "imu.rate": Kind(INFO, "IMU at {value:.4g} Hz, intervals vary by {jitter:.1f} %", unit="Hz"),
    "imu.slow": Kind(
        WARNING,
        "IMU at {value:.4g} Hz, below {limit:g} Hz",
        ("rotation and vibration between samples are lost",),
        ("log it at 10 Hz or more",),
        "Hz",
    ),
    "imu.gaps": Kind(
        INFO,
        "imu: {count} gap(s) of over {limit:g} s, bridged by the mean of both sides: the longest, {value:.2f} s "
        "at t = {at:.2f} s, leaves {angle:.1f} deg and {speed:.1f} m/s (1 sd)",
        unit="s",
    ),
    "imu.pause": Kind(
        WARNING,
        "imu: no samples for {value:.1f} s from t = {at:.2f} s ({count} gap(s) of over {limit:g} s): heading "
        "after it is unknown (sd {angle:.0f} deg) until the vehicle turns or accelerates",
        ("the logger paused",),
        ("run the parts by themselves: data.start, data.stop",),
        "s",
    ),
    "imu.polled": Kind(
        WARNING,
        "{value:.1f} % of the IMU's rows repeat the row before",
        ("the logger polled the sensor, and lost as many samples",),
        ("repair = true in a column map",),
        "%",
    ),
    "imu.lost": Kind(
        WARNING,
        "{value:.0f} % of the IMU's rows are missing between others (limit {limit:g} %)",
        ("the logger or its link is too slow",),
        ("log at a lower rate, or without loss",),
        "%",
    ),
    "imu.dead": Kind(
        WARNING, "{subject} is constant, {value:.3g}", ("a failed axis", "another column"), ("choose the column",)
    ),
    "imu.stuck": Kind(
        WARNING,
        "{subject} repeats {value:.4g} in {rows} rows from t = {at:.1f} s on",
        ("the sensor or its driver hung",),
        ("leave that part out: data.start, data.stop",),
    ),
    "imu.clipped": Kind(
        WARNING,
        "{subject} is at {value:.3g} in {share:.1f} % of the rows",
        ("beyond the sensor's range",),
        ("choose a larger range of the sensor",),
    ),
    "imu.gravity": Kind(INFO, "specific force {when} is {vector} m/s^2, norm {value:.2f} m/s^2", unit="m/s^2"),
    "imu.gravity_size": Kind(
        WARNING,
        "specific force {when} is {value:.2f} m/s^2, {share:+.1f} % from gravity",
        ("bias or scale error of the accelerometer",),
        ("set the unit or the scale of the accelerometer's columns",),
        unit="m/s^2",
    ),
    "imu.noise": Kind(
        INFO, "noise in the quietest seconds: gyro {gyro:.2g} deg/sqrt(h), accelerometer {accel:.3g} ug/sqrt(Hz)"
    ),
    "imu.quantized": Kind(
        WARNING,
        "{subject} is read in steps of {value:.3g} {unit_text}, above three times its noise: white noise is that of "
        "rounding, step / sqrt(12) a sample; slower noise does not show",
        ("coarse quantization",),
        ("log with more digits, or with a smaller range of the sensor",),
    ),
    "imu.bias": Kind(INFO, "biases of the gyros {gyro} deg/s, of the accelerometers {accel} m/s^2"),
    "gyro.bias": Kind(
        WARNING,
        "gyro {subject} has a bias of {value:+.2f} deg/s (sd {sd:.2f} deg/s, limit {limit:g} deg/s)",
        ("a sensor that was not calibrated", "another column"),
        ("set states.gyro_bias.sd_deg_per_s, or subtract it",),
        "deg/s",
    ),
    "accel.bias": Kind(
        WARNING,
        "accelerometer {subject} has a bias of {value:+.2f} m/s^2 (sd {sd:.2f} m/s^2, limit {limit:g} m/s^2)",
        ("a scale error (along gravity)", "a sensor that was not calibrated"),
        ("set states.accel_bias.sd_mg, or subtract it",),
        "m/s^2",
    ),
    # axes and units of the IMU
    "axes.gravity": Kind(
        WARNING,
        "accelerometer {subject} reads {value:+.1f} m/s^2 at rest; forward, right, down has z = -9.8",
        ("{cause}",),
        ("{action}",),
        "m/s^2",
    ),
    "gyro.turns": Kind(
        WARNING,
        "{subject} is about {value:.2g} times the course's rate (correlations {vector})",
        ("another scale or unit",),
        ("set the unit, or the scale of its column",),
        breaks_solution=True,
    ),
    "gyro": Kind(INFO, "correlation of the course's rate with the gyros: {vector}"),
    **{
        code: Kind(
            WARNING,
            "IMU and fixes agree better with a change: chi^2/dof {was:.3g} before, {then:.3g} after, log-likelihood "
            "{gain:+.0f}",
            ("{cause}",),
            (action,),
            breaks_solution=True,
        )
        for code, action in {
            "gyro.sign": "set axes or the sign of the gyro's columns",
            "gyro.swapped": "set axes or columns of the gyro",
            "gyro.units": "set the unit of the gyro",
            "gyro.scale": "set the scale of the gyro's columns",
            "accel.sign": "set axes or the sign of the accelerometer's columns",
            "accel.swapped": "set axes or columns of the accelerometer",
            "imu.swapped": "set axes",
            "fixes.swapped": "choose the columns of latitude and longitude",
            "fixes.sign": "set the sign of latitude or longitude",
        }.items()
    },
    "mounting.yaw": Kind(
        INFO,
        "the IMU points {value:+.1f} deg right of the course (median of {count}, scatter {scatter:.1f} deg)",
        unit="deg",
    ),
    "mounting.turned": Kind(
        WARNING,
        "the IMU points {value:+.1f} deg right of the course (median of {count}, scatter {scatter:.1f} deg)",
        ("it is turned in the vehicle", "the vehicle moves sideways"),
        ("set axes",),
        "deg",
    ),
    "lever_arm": Kind(
        WARNING,
        "the antenna is {vector} m forward, right, down from where it is stated (sd in brackets)",
        ("another lever arm",),
        ("set lever_arm_frd_m, or free it in jaxnav tune",),
        "m",
        exceeds_sd=True,
    ),
    # times
    "time.offset": Kind(
        WARNING,
        "IMU and fixes agree better if fixes are {value:+.1f} s late: chi^2/dof {was:.3g} before, {then:.3g} after, "
        "log-likelihood {gain:+.0f}",
        ("{cause}", "another time zone"),
        ("set data.options.time_shift_s = {value:.1f}",),
        "s",
        breaks_solution=True,
    ),
    "time.zone": Kind(
        INFO,
        "{subject} are moved by {value:.0f} s, {words}: else they miss the IMU's time, and IMU and fixes agree so "
        "(chi^2/dof {fit:.2g})",
        ("one logger stamps local time", "one counts from 1980, as GPS does, and one from 1970"),
        ("time_shift_s in the fixes' table of a column map states another time",),
        "s",
    ),
    "time.delay": Kind(
        INFO, "{subject} is {size:.3f} s {side} against the IMU (sd {sd:.3f} s)", ("{cause}",), unit="s"
    ),
    "time.late": Kind(
        WARNING,
        "{subject} is {size:.3f} s {side} against the IMU (sd {sd:.3f} s)",
        ("{cause}",),
        ("set measurements.{subject}.latency_s, or jaxnav tune",),
        "s",
    ),
    "time.drift": Kind(
        WARNING,
        "the delay changes by {value:+.0f} ppm (sd {sd:.0f} ppm)",
        ("the IMU's clock gains or loses",),
        ("set mounting.clock_drift_ppm",),
        "ppm",
    ),
    "time.jump": Kind(
        WARNING,
        "{subject} comes every {usual:.3g} s, but at t = {at:.2f} s {size:.2g} s too {side}{more}",
        ("a jump of its clock, or a restart of the receiver",),
        ("run the parts by themselves: data.start, data.stop",),
    ),
    "time.stream_offset": Kind(
        WARNING,
        "positions are stamped {size:.2g} s {side} velocities, constantly",
        ("a constant offset of one of the time columns",),
        ("set time_shift_s in the stream's table of a column map",),
    ),
    "time.overlap": Kind(
        WARNING,
        "{value:.0f} % of {subject} overlaps the IMU's time span, and covers {covered:.0f} % of it",
        ("another time origin", "another time scale", "another recording"),
        ("set data.options.time_shift_s, or choose the file of the same drive",),
        unit="%",
    ),
    # streams
    "file.unread": Kind(INFO, "messages of types that are not read, with their number: {words}"),
    "stream.empty": Kind(WARNING, "{subject}: {words}", ("{cause}",), ("choose the columns, or correct the times",)),
    "stream.short": Kind(
        WARNING,
        "{subject} {parts} {other}",
        ("a truncated file: beyond it one of the two is alone",),
        ("copy the log again, or set data.stop",),
    ),
    "stream.assumed_sd": Kind(
        INFO,
        "{subject}: the file states no sd; assumed are {words}{scan}",
        (),
        ("set data.options.sd, or sd in a column map, where it is known",),
    ),
    "stream.sd_jumps": Kind(
        WARNING,
        "the stated sd of {subject} changes by a factor of {value:.2g} a fix (median)",
        ("another column", "a damaged one"),
        ("choose the column of the sd, or set sd",),
    ),
    "position": Kind(INFO, "positions at {value:.3g} Hz{gaps}", unit="Hz"),
    "position.repeats": Kind(
        WARNING,
        "{value:.0f} % of the positions repeat the one before while the vehicle moves",
        ("the log repeats its last fix",),
        ("new_where in a column map takes those that changed",),
        "%",
    ),
    "position.sd": Kind(
        INFO,
        "positions scatter by {value:.2g} m, their stated sd is {limit:.2g} m",
        ("{cause}",),
        ("set sd",),
        "m",
    ),
    "velocity": Kind(
        INFO,
        "velocity differs from differences of positions by {value:.2f} m/s (rms; speed {size:.1f} m/s)",
        unit="m/s",
    ),
    **{
        f"velocity.{kind}": Kind(
            WARNING,
            "velocity differs from differences of positions by {value:.2f} m/s (rms; speed {size:.1f} m/s)",
            ("{cause}",),
            ("choose the columns, or set the unit of the velocity",),
            unit="m/s",
        )
        for kind in ("swapped", "sign", "units", "columns")
    },
    "velocity.turned": Kind(
        WARNING,
        "velocity is turned by {value:+.1f} deg against differences of positions (sd {sd:.1f} deg)",
        ("a course from magnetic north", "axes of another north"),
        ("set north_deg = {north:.1f} in [velocity] of a column map",),
        "deg",
    ),
    "heading": Kind(INFO, "heading is {value:+.1f} deg from the course (scatter {sd:.1f} deg)", unit="deg"),
    "heading.turned": Kind(
        WARNING,
        "heading is {value:+.1f} deg from the course (scatter {sd:.1f} deg)",
        ("antennas that are mounted across", "a heading from another north"),
        ("set measurements.heading.yaw_deg = {value:.1f}",),
        "deg",
    ),
    "heading.mirrored": Kind(
        WARNING,
        "heading and course add up to {value:+.1f} deg (scatter {sd:.1f} deg)",
        ("a yaw that grows to the left, of ROS from the east",),
        ('value = "-COLUMN" and north_deg = {north:.1f} in [heading] of a column map',),
        "deg",
    ),
    "velocity.vertical": Kind(INFO, "vertical velocity and differences of height correlate by {value:+.2f}"),
    "velocity.vertical_sign": Kind(
        WARNING,
        "vertical velocity and differences of height correlate by {value:+.2f}",
        ("wrong sign: up is positive here, most receivers give down",),
        ("choose the column as down instead of up",),
    ),
    "velocity.vertical_units": Kind(
        WARNING,
        "heights change by {value:.2f} times the vertical velocity (correlation {corr:+.2f})",
        ("{cause}",),
        ("set the unit, or h_unit, in a column map",),
    ),
    "velocity.latency": Kind(
        INFO,
        "velocity is {size:.2f} s {side} than the position (sd {sd:.2f} s)",
        ("a receiver that differences positions",),
        ("set measurements.velocity.latency_s",),
        "s",
    ),
    "speed": Kind(INFO, "wheel speed is {value:.3f} times the receiver's (median)"),
    "speed.units": Kind(
        WARNING, "wheel speed is {value:.3f} times the receiver's (median)", ("{cause}",), ("set unit",)
    ),
    "speed.scale": Kind(
        WARNING,
        "wheel speed is {value:.3f} times the receiver's (median)",
        ("another unit", "another wheel radius"),
        ("set the unit, or free measurements.speed.scale in jaxnav tune",),
    ),
    "speed.parts": Kind(
        WARNING,
        "speeds of receiver and wheels part by {value:.1f} m/s between t = {begin:.0f} and {end:.0f} s (limit "
        "{limit:.1f} m/s)",
        ("the receiver's fixes are dragged off", "wheels that slip"),
        ("compare with a map", "leave one of them out: filter.outages, filter.measurements"),
        "m/s",
        exceeds_sd=True,
    ),
    "speed.unsigned": Kind(
        WARNING,
        "wheel speed is never negative, and the vehicle changes between forwards and backwards at t = {value:.1f} s",
        ("a sensor that does not know the sense of rotation",),
        ("leave speed out of filter.measurements, or choose a column with a sign",),
        "s",
    ),
    "barometer": Kind(
        INFO, "barometric height changes by {value:+.2f} m per metre of height (correlation {corr:+.2f})"
    ),
    "barometer.sign": Kind(
        WARNING,
        "barometric height changes by {value:+.2f} m per metre of height (correlation {corr:+.2f})",
        ("a depth, or a pressure read as a height",),
        ("choose the column of the height, or set the unit Pa or hPa",),
    ),
    "barometer.units": Kind(
        WARNING,
        "barometric height changes by {value:+.2f} m per metre of height (correlation {corr:+.2f})",
        ("{cause}",),
        ("set the unit of the barometer",),
    ),
    "barometer.parts": Kind(
        WARNING,
        "heights of receiver and barometer part by {value:.0f} m between t = {begin:.0f} and {end:.0f} s (limit "
        "{limit:.0f} m)",
        ("the receiver's height is off", "a barometer in a draught, or of another temperature"),
        ("compare with a map", "leave one of them out: filter.outages, filter.measurements"),
        "m",
        exceeds_sd=True,
    ),
    "compass": Kind(INFO, "magnetic field of {value:.1f} uT{here}", unit="uT"),
    "compass.strength": Kind(
        WARNING,
        "magnetic field of {value:.1f} uT{here}",
        ("iron nearby", "another unit"),
        ("set the unit, or leave the magnetometer out of filter.measurements",),
        unit="uT",
    ),
    "compass.axes": Kind(
        WARNING,
        "rotations explain {value:.0f} % of the changes of the magnetic field",
        ('with axes = "{axes}" in [magnetometer] {most:.0f} %, or turned about the axis of rotation',),
        ("set axes",),
        "%",
    ),
    "compass.turns": Kind(INFO, "rotations explain {value:.0f} % of the changes of the magnetic field", unit="%"),
    "compass.iron": Kind(
        INFO,
        "rotations explain {value:.0f} % of the changes of the magnetic field; hard iron of {vector} uT",
        (),
        ("add the state magnetometer_bias",),
        "%",
    ),
    "compass.inconsistent": Kind(
        WARNING,
        "rotations explain {value:.0f} % of the changes of the magnetic field",
        ("moving iron", "another clock", "axes that are not orthogonal to the IMU's"),
        ("leave the magnetometer out of filter.measurements",),
        unit="%",
    ),
    "compass.parts": Kind(
        WARNING,
        "headings of the solution and of the magnetometer part by {value:.0f} deg between t = {begin:.0f} and "
        "{end:.0f} s (limit {limit:.0f} deg)",
        ("a heading that was lost", "iron that moves", "a receiver that is dragged off"),
        ("look at heading and its sd there", "add the magnetometer to filter.measurements"),
        "deg",
        exceeds_sd=True,
    ),
    # motion and standstill
    "motion": Kind(INFO, "IMU and fixes agree: chi^2 {value:.2g} per degree of freedom in {count} windows"),
    "motion.sd": Kind(
        INFO,
        "the stated sd of {subject} are {value:.1f} times too {side}, by its scatter within {span:g} s",
        ("a receiver that is cautious or bold, or one whose errors change slowly", "variances in the place of sd"),
        ("set sd, or jaxnav filter, whose noise scan finds it",),
    ),
    "motion.little": Kind(INFO, "too little motion to compare IMU and fixes"),
    "motion.misfit": Kind(
        WARNING,
        "IMU and fixes disagree: chi^2 {value:.2g} per degree of freedom in {count} windows (limit {limit:g})",
        ("axes, units, times or columns are wrong", "fixes are worse than their sd"),
        ("jaxnav check with other axes, units or time_shift_s in data.options",),
    ),
    "standstill": Kind(
        INFO,
        "{count} s at rest by the receiver: no IMU threshold separates rest from motion: the best takes for rest "
        "{caught:.0f} % of them and {false:.1f} % of {moving} s in motion",
    ),
    "standstill.accel": Kind(
        INFO,
        "{count} s at rest by the receiver: there specific force spreads by less than {value:.3g} m/s^2 in "
        "{window:g} s",
        unit="m/s^2",
    ),
    "standstill.gyro": Kind(
        INFO,
        "and the rate by less than {value:.3g} deg/s: both together take for rest {caught:.0f} % of them and "
        "{false:.1f} % of {moving} s in motion",
        unit="deg/s",
    ),
    # a run
    "nis.high": Kind(
        WARNING,
        "innovations of {subject} exceed their predicted variance: {vector} times (limit {limit:.2f}); stated standard "
        "deviations are too small",
        ("noise set too low", "delay", "a receiver fault", "lever arm", "axes", "initialization"),
        ("jaxnav check", "jaxnav tune", 'filter.name = "ekf15_receiver"'),
    ),
    "nis.low": Kind(
        WARNING,
        "innovations of {subject} are below their predicted variance: {vector} times (limit {limit:.2f})",
        ("the stated sd of the fixes, or the IMU's noise, is too large",),
        ("jaxnav tune",),
    ),
    "nis.overall": Kind(
        WARNING,
        "NIS/dof of all channels is {value:.3g} (limit {limit:.2f}), though each alone is within its bounds",
        ("noise settings, a sensor or a delay is slightly wrong",),
        ("jaxnav check", "jaxnav tune"),
    ),
    "innovations.correlated": Kind(
        WARNING,
        "innovations of {subject} are correlated from fix to fix: {vector}; errors last, and do not average out",
        ("delay", "lever arm", "scale factor", "a receiver with slow errors"),
        ("add the state gnss_position_error",),
    ),
    "stream.unused": Kind(INFO, "{subject}: {used} of {read} samples used; {why}"),
    "stream.refused": Kind(
        WARNING,
        "{subject}: none of {read} samples used: {why}",
        ("fixes far from the prediction", "times outside the run"),
        ("jaxnav check", "jaxnav tune"),
    ),
    "stream.extra": Kind(INFO, "not used of the recording: {subject}", (), ("add it to filter.measurements",)),
    "ranges.ionosphere": Kind(
        WARNING,
        "{subject} states no ionosphere: its delay is left in the ranges, by day some 3 m at the zenith and three "
        "times that near the horizon",
        ("the messages were logged for too short a time", "a converter that drops them"),
        ("take the navigation messages of a station nearby: option nav",),
    ),
    "satellite.rejected": Kind(
        WARNING,
        "{subject}: {rejected} of {read} pseudoranges rejected, {value:.0f} m off in the median, {first:.0f} to "
        "{last:.0f} s",
        ("a reflected signal", "a fault of the satellite", "a wrong ephemeris"),
        ("raise data.options elevation_mask_deg or cn0_mask_dbhz", 'jaxnav tune with tune.free = ["ranges"]'),
    ),
    "imu.noise_high": Kind(
        WARNING,
        "{subject} noise in the quietest seconds is {value:.3g} {unit_text}, {ratio:.0f} times the assumed",
        ("vibration", "another grade", "another unit"),
        ("filter.grade", "jaxnav check", "jaxnav tune"),
    ),
    "imu.noise_axis": Kind(
        WARNING,
        "{subject} noise in the quietest seconds is {value:.3g} {unit_text}, {ratio:.0f} times the assumed; the "
        "other axes have at most {limit:.3g}",
        ("a failing sensor or wire", "coarse quantization"),
        ("replace the sensor, or set noise.gyro or noise.accel per axis",),
    ),
    "observability.rank": Kind(
        INFO, "{count} windows of {window:g} s observe {span} of {n} directions of the state (median {value:.0f})"
    ),
    "observability.never": Kind(
        INFO, "no window observes {subject}", (), ("turns, changes of speed and tilts do; until then the prior holds",)
    ),
    "observability.seldom": Kind(INFO, "few windows observe {subject}"),
    "observability.unknown": Kind(INFO, "observability cannot be computed: {why}"),
    "state.unobserved": Kind(INFO, "not observable in this motion: {subject}; their sd is as at the start"),
    "state.unexpected": Kind(
        WARNING,
        "estimates far from their prior: {subject}",
        ("another grade", "another unit", "a failing sensor", "an error that is no state of the filter"),
        ("jaxnav check", "set the prior sd in [states]"),
    ),
    "truth.share": Kind(INFO, "truth covers {value:.0f} % of the epochs; errors are of these alone", unit="%"),
    "heading.hypotheses": Kind(
        INFO, "heading unknown: {value:g} deg at the start is the most probable ({probability:.2f})", unit="deg"
    ),
    "noise.scan": Kind(
        INFO,
        "noise by likelihood: gyro {gyro:.3g} and accelerometer {accel:.3g} times the datasheet's, fixes {size:.2f} s "
        "{side} (log-likelihood {gain:+.2f} a fix, {fixes} fixes of {first:.0f} to {last:.0f} s){scale}",
    ),
    "noise.harm": Kind(
        INFO,
        "noise by likelihood drifts {value:.2f} times as far as the datasheet over hidden windows (limit {limit:g}): "
        "{kept} is taken",
        ("scale, unit or axes of a sensor", "an unmodelled delay"),
        ("jaxnav check",),
    ),
    "noise.slow": Kind(
        INFO,
        "{subject} slow errors of the receiver are assumed, {value:.2g} of the stated variance over {ratio:.0f} s: the "
        "fixes are too few or too alike to show them",
        (),
        ("set filter.states and states.gnss_position_error where they are known",),
    ),
    "noise.vibration": Kind(
        WARNING,
        "noise by likelihood is {value:.3g} times the datasheet's (limit {limit:g})",
        ("strong vibration", "another unit", "another grade"),
        ("jaxnav check",),
    ),
    "noise.datasheet": Kind(
        INFO, "noise of the datasheet: fewer than {limit:g} fixes to estimate it from", (), ("set filter.grade",)
    ),
    # tuning and Monte Carlo
    "time.clocks": Kind(
        WARNING,
        "fixes are late by {vector}, and one delay is tuned for all",
        ("loggers with separate clocks",),
        ("jaxnav check", 'tune.per_recording = ["timing"]'),
    ),
    "tune.fault": Kind(
        WARNING,
        "{value:.0f} of {of} hidden windows of the {subject} part, from t = {first:.0f} to {last:.0f} s, disagree with "
        "every candidate: {done}",
        ("a receiver fault", "a motion that the rest of the recording has not"),
        ("data.start, data.stop", 'filter.name = "ekf15_receiver"'),
    ),
    "tune.aside": Kind(
        WARNING,
        "{subject} is left out from step {step} on: {why}",
        ("parameters far from the start",),
        ("set a smaller tune.rate",),
    ),
    "tune.undetermined": Kind(INFO, "{subject} is not determined by these data: one sd is {size}"),
    "tune.indistinguishable": Kind(INFO, "{subject} are not distinguishable: one sd of {direction} is {size}"),
    # a solution
    "solve.applied": Kind(
        INFO, "{subject} = {value:g} is applied: {why}", (), ("set {subject} to keep another value",)
    ),
    "solve.axes": Kind(
        INFO,
        '{subject} = "{axes}" is applied: {why}; the gyros agree',
        (),
        ("set {subject} to keep other axes",),
    ),
    "solve.measurement": Kind(
        INFO,
        "{subject} is taken{times}: {value:.2f} times the horizontal drift without it, log-likelihood of a hidden fix "
        "{gain:+.2f}",
    ),
    "solve.left_out": Kind(
        INFO,
        "{subject} is left out{times}: {value:.2f} times the horizontal drift without it, log-likelihood of a hidden "
        "fix {gain:+.2f}",
        (),
        ("filter.measurements of jaxnav filter takes it all the same",),
    ),
    "solve.inflated": Kind(
        INFO,
        "{subject} are {value:.2f} times the filter's: errors of {count} hidden fixes of the test part ask for it; "
        "those of attitude are the filter's",
    ),
    "solve.fault": Kind(
        WARNING,
        "the receiver's fixes of t = {words} are left out: those before and after are far likelier without them "
        "(log-likelihood {gain:+.0f})",
        ("a receiver that was dragged off, jumped or became noisy, and came back",),
        ("jaxnav filter takes them, or leaves out others: filter.outages",),
        "s",
    ),
    "solve.jump": Kind(
        WARNING,
        "{subject} jump by {value:.1f} m at t = {t:.1f} s and stay, against the IMU: they are wrong before or after it",
        ("a receiver that was off and came back, or is off since", "corrections that begin or end", "a log of two"),
        ("compare with a map", "jaxnav filter without the wrong side: filter.outages"),
        "m",
        exceeds_sd=True,
    ),
    "solve.short": Kind(
        INFO,
        "{value:.0f} s are too short to tune and to test: no hidden window fits into every part",
        (),
        ("record {limit:.0f} s or more",),
        "s",
    ),
    "solve.time": Kind(
        INFO,
        "not done, since it would not have ended within {limit:.0f} s: {subject}",
        (),
        ("jaxnav solve without --time, or with more",),
        "s",
    ),
    "mc.diverged": Kind(
        WARNING,
        "{subject} diverged in {value:.0f} of {runs} runs: {first}",
        ("noise set too low", "an initial error beyond its prior"),
        ("jaxnav tune", "set the initial sd in [initialization]"),
    ),
    "mc.anees": Kind(INFO, "{subject}: ANEES / 9 {value:.2f}, {share:.0f} % of epochs inside 95 % bounds"),
    "mc.anis": Kind(INFO, "{subject}: ANIS / dof {value:.4f} (95 %: {low:.4f} to {limit:.4f})"),
    "lever_arm.recorded": Kind(
        INFO, "lever arm {vector} m from the recording", (), ("mounting.lever_arm_m sets another one",), "m"
    ),
    "lever_arm.stated": Kind(INFO, "lever arm {vector} m as stated; the recording has {other} m", unit="m"),
}


def finding(
    code: str,
    subject: str = "",
    value: float | None = None,
    limit: float | None = None,
    *,
    setting: str = "",
    severity: Severity | None = None,
    **numbers: Any,
) -> Finding:
    """Return a finding of a kind.

    Args:
        code: a row of `KINDS`.
        subject: stream and channel, sensor and axis, or state.
        value: the quantity found, in the kind's unit.
        limit: the limit that it is compared with.
        setting: a setting that would take ``value``.
        severity: in place of the kind's.
        numbers: of the kind's texts.
    """
    kind = KINDS[code]
    write = lambda text: text.format(subject=subject, value=value, limit=limit, **numbers)
    causes, actions = (tuple(map(write, texts)) for texts in (kind.causes, kind.actions))
    severity = kind.severity if severity is None else severity
    return Finding(code, severity, subject, value, limit, kind.unit, write(kind.message), causes, actions, setting)


def line(f: Finding) -> str:
    """Return a finding in one line."""
    likely = f"; likely: {', '.join(f.causes)}" if f.causes else ""
    return f"{f.message}{likely}" + (f"; next: {', '.join(f.actions)}" if f.actions else "")


def warnings(findings: Iterable[Finding], color: bool = False) -> list[str]:
    """Return at most three lines per warning: message, likely causes, next steps.

    Args:
        findings: findings of any severity.
        color: highlight the severity by an escape sequence of a terminal.
    """
    lines: list[str] = []
    for f in findings:
        if f.warns:
            name = f"\033[1;33m{f.severity.name}\033[0m" if color else f.severity.name
            lines.append(f"{name} {f.code}  {f.message}")
            lines += [f"        Likely: {', '.join(f.causes)}"] if f.causes else []
            lines += [f"        Next:   {', '.join(f.actions)}"] if f.actions else []
    return lines


def remarks(findings: Iterable[Finding]) -> list[str]:
    """Return one line per finding that is no warning."""
    return [f"  {line(f)}" for f in findings if not f.warns]
