"""Findings of runs, tunings, Monte Carlo and solutions."""

from jaxnav.kinds.kind import INFO, WARNING, Kind

KINDS: dict[str, Kind] = {
    # a start
    "start": Kind(INFO, "starts at t = {value:.3f} s: {words}", unit="s"),
    "start.late": Kind(
        INFO,
        "fixes look {value:.2f} s {side} (sd {sd:.2f} s): see measurements.position.latency_s, "
        "measurements.velocity.latency_s",
        unit="s",
    ),
    "start.upside_down": Kind(INFO, "the IMU hangs upside down, or its axes are not forward, right, down", unit="deg"),
    "start.misfit": Kind(
        INFO,
        "IMU and fixes disagree (chi^2 {value:.0f} per degree of freedom): axes, units or times may be wrong, see "
        "jaxnav check",
    ),
    "start.field": Kind(
        INFO,
        "magnetic field by the World Magnetic Model: declination {value:.1f} deg, inclination {inclination:.1f} deg, "
        "{strength:.1f} uT",
        unit="deg",
    ),
    "start.no_field": Kind(INFO, "magnetic declination unknown: {install}"),
    "start.gone_back": Kind(INFO, "smoothed from t = {value:.3f} s on", unit="s"),
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
