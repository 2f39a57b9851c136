"""Findings of the checks of a recording: IMU, axes and units, times, streams, motion."""

from jaxnav.kinds.kind import INFO, WARNING, Kind

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
}
