"""Typical mistakes of users are answered by one line that names the key and the remedy."""

import tomllib

import pytest

from lake_schema.errors import BadInput
from truesky.request.from_toml import parse, read_valid_parts

HEAD = 'name = "x"\nseed = 1\n'
AREA = "[area]\ncone = { ra = 53.117, dec = -27.808, radius = 0.2 }\n"
POINT = """[[pointing]]
channel = "VIS"
band = "euclid_vis"
ra = 53.117
dec = -27.808
detectors = ["3-4"]
mjd = 60905.0
"""
GOOD = HEAD + AREA + POINT
EUCLID = HEAD + AREA + '[[observation]]\nchannels = ["VIS"]\nra = 53.117\ndec = -27.808\n'
GROUND = HEAD + AREA + '[[observation]]\nchannels = ["EXT"]\nsurvey = "lsst"\nra = 53.117\ndec = -27.808\n'


def changed(old, new, text=GOOD):
    assert old in text
    return text.replace(old, new)


def area(line):
    return f"{HEAD}[area]\n{line}\n"


def section(name, line):
    return f"{GOOD}[{name}]\n{line}\n"


# Text of the request, words that name the key, words that name the remedy.
MISTAKES = {
    "no name": (changed('name = "x"\n', ""), "name is missing", "text in quotes"),
    "a name with blanks": (changed('"x"', '"My Field"'), "name = 'My Field'", "small letters, digits"),
    "no seed": (changed("seed = 1\n", ""), "seed is missing", "a whole number from 0"),
    "a seed of text": (
        changed("seed = 1", 'seed = "1"'),
        "seed must be a whole number",
        "write it without quotes, seed = 1",
    ),
    "pointings": (changed("[[pointing]]", "[[pointings]]"), "pointings is not a key", "did you mean [[pointing]]?"),
    "a negative seed": (changed("seed = 1", "seed = -1"), "seed = -1", "[0, 9223372036854775807]"),
    "noise seed": ("noiseseed = 1\n" + GOOD, "noiseseed is not a key", "did you mean noise_seed?"),
    "one number for the accuracy": (
        "accuracy = 1e-3\n" + GOOD,
        "accuracy = 0.001",
        "quicklook, draft, survey, reference, or a",
    ),
    "an accuracy of no name": ('accuracy = "high"\n' + GOOD, "accuracy = 'high'", "{ flux = 1e-3, shape = 1e-4"),
    "an accuracy in capitals": ('accuracy = "Survey"\n' + GOOD, "accuracy = 'Survey'", "did you mean survey?"),
    "no area": (HEAD + POINT, "area is missing: add [area] with a line such as", "such as cone = { ra = 150.1"),
    "an empty area": (area(""), "area must have exactly one of polygon, cone", "such as cone = { ra = 150.1"),
    "sead": (changed("seed = 1", "sead = 1"), "sead is not a key of a request; ", "did you mean seed?"),
    "an area misspelt": (changed("[area]", "[aera]"), "aera is not a key of a request; ", "did you mean [area]?"),
    "a required key of a pointing misspelt": (
        changed("channel", "chhannel"),
        "pointing[0].chhannel is not a key",
        "did you mean channel?",
    ),
    "two areas": (changed("0.2 }", "0.2 }\ntile = 3"), "area must have exactly one", "it has cone, tile"),
    "a radius in arcmin": (
        changed("0.2 }", '"17 arcmin" }'),
        "area.cone.radius must be a number from 0 to 180 deg, got '17 arcmin': ",
        "write 0.2833",
    ),
    "a spacing in degrees": (
        changed(POINT, '[sources]\nonly = "grid"\nstars = "x.csv"\nspacing = "0.01 deg"\n'),
        "sources.spacing must be a number from 0.01 to 3600 arcsec, got '0.01 deg': ",
        "write 36",
    ),
    "a circle as a list": (
        area("cone = [53.1, -27.8, 0.1]"),
        "area.cone must be a table, not a list: ",
        "write area.cone = { ra = 53.1, dec = -27.8, radius = 0.1 }",
    ),
    "a radius in quotes": (changed("0.2 }", '"0.2" }'), "area.cone.radius", "write it without quotes, radius = 0.2"),
    "a radius above 180": (changed("0.2 }", "500 }"), "area.cone.radius = 500", "[0.0, 180.0] deg"),
    "a circle without braces": (
        area("ra = 53.1\ndec = -27.8\nradius = 12"),
        "area: ra, dec, radius must be in a table",
        "in degrees: cone = { ra = 53.1, dec = -27.8, radius = 12 }",
    ),
    "a radius without a cone": (area("radius = 1"), "area: radius must be", "cone = { ra = .., dec = .., radius = 1 }"),
    "r": (changed("radius", "r"), "area.cone.r is not a key", "did you mean radius?"),
    "no radius": (changed(", radius = 0.2", ""), "area.cone.radius is missing", "a number from 0 to 180 deg"),
    "rad": (changed("radius", "rad"), "area.cone.rad is not a key", "did you mean radius?"),
    "a declination beyond the pole": (changed("-27.808, r", "-97.808, r"), "area.cone.dec = -97.808", "[-90.0, 90.0]"),
    "an exchanged circle": (
        area("cone = { ra = -27.8, dec = 153.1, radius = 0.2 }"),
        "area.cone.dec = 153.1 is outside [-90.0, 90.0]: ",
        "are ra and dec exchanged?",
    ),
    "an exchanged vertex": (
        area("polygon = [[53, -28], [-28, 154], [54, -27]]"),
        "area.polygon[1].dec = 154 is outside",
        "are ra and dec exchanged?",
    ),
    "an exchanged pointing": (
        changed("ra = 53.117\ndec = -27.808\nd", "ra = -27.808\ndec = 153.117\nd"),
        "pointing[0].dec = 153.117 is outside",
        "are ra and dec exchanged?",
    ),
    "an exchanged field": (
        changed("ra = 53.117\ndec = -27.808\n", "ra = -27.808\ndec = 153.117\n", EUCLID),
        "observation[0].dec = 153.117 is outside",
        "are ra and dec exchanged?",
    ),
    "two vertices": (
        area("polygon = [[53, -28], [54, -28]]"),
        "area.polygon must be",
        "3 to 1000 [ra, dec] in degrees, got 2",
    ),
    "a polygon that crosses itself": (
        area("polygon = [[53, -28], [54, -27], [54, -28], [53, -27]]"),
        "area.polygon",
        "must be convex",
    ),
    "a box the wrong way round": (
        area("box = { ra = [54, 52], dec = [-29, -27] }"),
        "area.box.ra",
        "the second must be east of the first",
    ),
    "a box with other keys": (
        area("box = { ra_min = 52, ra_max = 54, dec_min = -29, dec_max = -27 }"),
        "area.box must have ra and dec, got ra_min, ra_max, dec_min, dec_max",
        "write box = { ra = [150, 151], dec = [2, 3] } (deg)",
    ),
    "a circle": (
        area("circle = { ra = 1, dec = 2, radius = 1 }"),
        "area.circle",
        "did you mean cone = { ra = 1, dec = 2, radius = 1 }?",
    ),
    "vertices": (area("vertices = [[1, 2], [2, 2], [2, 3]]"), "area.vertices", "did you mean polygon?"),
    "a key misspelt": (section("universe", "galaxy_limt = 25"), "universe.galaxy_limt", "did you mean galaxy_limit?"),
    "a number in quotes": (
        section("universe", 'galaxy_limit = "25"'),
        "universe.galaxy_limit",
        "10 to 30 mag, got '25' in quotes",
    ),
    "too deep": (section("universe", "galaxy_limit = 99"), "universe.galaxy_limit = 99", "[10.0, 30.0]"),
    "a key above its section": ("galaxy_limit = 25\n" + GOOD, "galaxy_limit is not a key", "it belongs in [universe]"),
    "a section in capitals": (section("Universe", "z_max = 2.0"), "Universe is not a key", "did you mean [universe]?"),
    "a box of another size": (section("universe", "box_cells = 200"), "universe.box_cells = 200", "192, 256, 384"),
    "lensing on": (section("universe", "lensing = true"), "universe.lensing", '"box", "none" or a table such as'),
    "one bracket": (
        changed("[[pointing]]", "[pointing]"),
        "pointing must be a list of tables: ",
        "write [[pointing]] instead of [pointing]",
    ),
    "a band in capitals": (
        changed("euclid_vis", "VIS"),
        "pointing[0].band",
        "did you mean euclid_vis? allowed: euclid_vis",
    ),
    "a band of another camera": (
        changed("euclid_vis", "lsst_r"),
        "pointing[0].band: camera vis has no band 'lsst_r': lsst_r is a band of camera lsstcam, write",
        'write channel = "EXT" and camera = "lsstcam", or band = "euclid_vis"',
    ),
    "a band of another channel": (
        changed("euclid_vis", "euclid_h"),
        "pointing[0].band: camera vis has no band 'euclid_h': euclid_h is a band of NISP-P, ",
        'write channel = "NISP-P", or band = "euclid_vis"',
    ),
    "a band of another ground camera": (
        changed('channel = "VIS"\nband = "euclid_vis"', 'channel = "EXT"\ncamera = "lsstcam"\nband = "des_r"').replace(
            'detectors = ["3-4"]\n', ""
        ),
        "camera lsstcam has no band 'des_r': des_r is a band of camera decam, ",
        'write channel = "EXT" and camera = "decam", or band = "lsst_r"',
    ),
    "a band of a grism": (
        changed('channel = "VIS"\nband = "euclid_vis"', 'channel = "NISP-P"\nband = "nisp_red"').replace(
            'detectors = ["3-4"]\n', ""
        ),
        "nisp_red is a band of NISP-S, ",
        'write channel = "NISP-S", or one of euclid_y, euclid_j or euclid_h',
    ),
    "a published name of a band": (changed("euclid_vis", "I_E"), "pointing[0].band", "did you mean euclid_vis?"),
    "a published name of another channel's band": (
        changed("euclid_vis", "H_E"),
        "camera vis has no band 'H_E': euclid_h is a band of NISP-P, ",
        'write channel = "NISP-P", or band = "euclid_vis"',
    ),
    "bands of another channel": (
        EUCLID + 'bands = ["euclid_h"]\n',
        "observation[0].bands: VIS has no band 'euclid_h': euclid_h is a band of NISP-P, ",
        'write channels = ["NISP-P"], or bands = ["euclid_vis"]',
    ),
    "a band of another survey": (
        GROUND + 'bands = ["des_r"]\n',
        "observation[0].bands: survey lsst has no band 'des_r': des_r is a band of survey des, ",
        'write channels = ["EXT"] and survey = "des", or bands = ["lsst_r"]',
    ),
    "the blue grism": (
        changed('["VIS"]', '["NISP-S"]', EUCLID) + 'bands = ["nisp_blue"]\n',
        "observation[0].bands: NISP-S has no band 'nisp_blue'",
        'write channels = ["NISP-S"] and blue = true',
    ),
    "a camera in capitals": (
        changed('channel = "VIS"\nband = "euclid_vis"', 'channel = "EXT"\ncamera = "LSSTCam"'),
        "pointing[0].camera",
        "did you mean lsstcam? allowed: decam, gpc1",
    ),
    "a channel in small letters": (
        changed('"VIS"', '"vis"'),
        "pointing[0].channel",
        "did you mean VIS? allowed: VIS, NISP-P",
    ),
    "half a channel": (changed('"VIS"', '"NISP"'), "pointing[0].channel", "did you mean NISP-P or NISP-S?"),
    "a detector of another name": (changed('"3-4"', '"CCD_7"'), "pointing[0].detectors", "allowed: 1-1, 1-2, 1-3"),
    "a detector misspelt": (changed('"3-4"', '"3_4"'), "pointing[0].detectors", "did you mean 3-4?"),
    "one detector": (changed('["3-4"]', '"3-4"'), "pointing[0].detectors", "a list of texts such as ['3-4']"),
    "a Julian date": (changed("60905.0", "2460905.5"), "pointing[0].mjd", "write the MJD 60905"),
    "a date of words": (changed("60905.0", '"1 Jan 2027"'), "pointing[0].mjd", 'a date in UTC such as "2027-01-01"'),
    "degrees in quotes": (
        changed("ra = 53.117\nd", 'ra = "53.117"\nd'),
        "pointing[0].ra",
        "a number in degrees, or hours",
    ),
    "a negative time": (GOOD + "exposure_time_s = -5\n", "pointing[0].exposure_time_s = -5", "[0.0, 1000000.0]"),
    "exptime": (GOOD + "exptime = 100\n", "pointing[0].exptime", "did you mean exposure_time_s?"),
    "an image type of a pointing": (
        GOOD + 'image_type = "dark"\n',
        "pointing[0].image_type",
        "it belongs in [[observation]]",
    ),
    "bands of a pointing": (changed("band =", "bands ="), "pointing[0].bands", "did you mean band?"),
    "a seed below a section": (GOOD + "noise_seed = 1\n", "pointing[0].noise_seed", "at the top of the file"),
    "channels without brackets": (changed('["VIS"]', '"VIS"', EUCLID), "observation[0].channels", "such as ['VIS']"),
    "a camera as channel": (
        changed('["VIS"]', '["LSST"]', EUCLID),
        "observation[0].channels",
        "did you mean EXT? allowed: VIS, NISP-P",
    ),
    "Euclid and the ground": (
        changed('["VIS"]', '["VIS", "EXT"]', EUCLID),
        "[0].channels",
        "use another [[observation]]",
    ),
    "an image type of NISP": (EUCLID + 'image_type = "standard_star"\n', "[0].image_type", "science, deep, bias, dark"),
    "an image type misspelt": (EUCLID + 'image_type = "sciense"\n', "[0].image_type", "did you mean science?"),
    "a survey in capitals": (changed('"lsst"', '"LSST"', GROUND), "observation[0].survey", "did you mean lsst?"),
    "an observatory as survey": (
        changed('"lsst"', '"Rubin"', GROUND),
        "observation[0].survey = 'Rubin' is not allowed: ",
        "did you mean lsst? allowed: des, lsst",
    ),
    "visits of a ground camera": (
        GROUND + "visits = 3\n",
        "observation[0].visits is not for a ground camera's field",
        "use exposures; its keys are exposures",
    ),
    "no survey": (changed('survey = "lsst"\n', "", GROUND), "observation[0].survey is missing", "des, lsst, cfis"),
    "a short name of a band": (
        GROUND + 'bands = ["r"]\n',
        "observation[0].bands",
        "did you mean lsst_r? allowed: lsst_u",
    ),
    "one band": (GROUND + 'bands = "lsst_r"\n', "observation[0].bands", "such as ['lsst_r']"),
    "a position angle": (GOOD + "pa = 30\n", "pointing[0].pa is not a key", "did you mean position_angle?"),
    "a shear of another name": (
        section("universe", "lensing = { gamma1 = 0.1, g2 = 0 }"),
        "universe.lensing.gamma1 is not a key of a request; ",
        "did you mean g1? allowed here: g1, g2",
    ),
    "a dither in small letters": (
        EUCLID + 'dither = "s"\n',
        "observation[0].dither = 's' is not allowed: did you mean S?",
        "S? use S, J, none or a list of offsets",
    ),
    "a number of dithers": (EUCLID + "dither = 4\n", "observation[0].dither = 4", "S, J, none or a list of offsets"),
    "exposures of a Euclid field": (
        EUCLID + "exposures = 3\n",
        "observation[0].exposures",
        "visits repeats the exposures; its keys are visits, dither",
    ),
    "a detector of NISP": (EUCLID + 'detectors = ["DET22"]\n', "observation[0].detectors", "allowed: 1-1, 1-2"),
    "no file": (
        changed("ra = 53.117\ndec = -27.808\n", 'pointings = "q.csv"\n', EUCLID),
        "[0].pointings",
        "no such file",
    ),
    "truth misspelt": (section("products", 'truth = ["noisefree"]'), "products.truth", "did you mean noise_free?"),
    "one truth": (section("products", 'truth = "stars"'), "products.truth", "such as ['stars']"),
    "an unknown compression": (section("products", 'compression = "gzip"'), "products.compression", "none, rice"),
    "an effect misspelt": (section("effects", 'off = ["cosmics"]'), "effects.off", "did you mean cosmic_rays?"),
    "an effect as key": (section("effects", "cosmic_rays = false"), "effects.cosmic_rays", "the lists on and off"),
    "a parameter misspelt": (
        section("mission.overrides", '"vis.gian" = { value = 3.0, unit = "" }'),
        "mission.overrides.vis.gian",
        "did you mean vis.gain?",
    ),
    "a parameter without a unit": (
        section("mission.overrides", '"vis.gain" = 3.0'),
        "mission.overrides.vis.gain",
        'has no unit: write "vis.gain" = { value = 3.0, unit = "electron / adu" }',
    ),
    "a parameter without quotes": (
        section("mission.overrides", 'vis.gain = { value = 3.0, unit = "" }'),
        "mission.overrides.vis",
        'in quotes, such as "vis.gain" = { value = 3.0, unit = "electron / adu" }',
    ),
    "a parameter without quotes and unit": (
        section("mission.overrides", "vis.gain = 3.0"),
        "mission.overrides.vis",
        'in quotes, such as "vis.gain" = { value = 3.0, unit = "electron / adu" }',
    ),
    "a parameter whose unit is missing": (
        section("mission.overrides", '"vis.gain@3-4" = { value = 3.0 }'),
        "mission.overrides.vis.gain@3-4.unit is missing",
        'write "vis.gain@3-4" = { value = 3.0, unit = "electron / adu" }',
    ),
    "a parameter in another section": (
        section("mission", '"vis.gain" = 3.0'),
        "mission.vis.gain is not a key",
        'it belongs in [mission.overrides] as "vis.gain" = { value = 3.0, unit = "electron / adu" }',
    ),
    "an unknown parameter without a unit": (
        section("mission.overrides", '"vis.gian" = "x"'),
        "mission.overrides.vis.gian = 'x': no parameter vis.gian exists",
        'did you mean vis.gain? write "vis.gain" = { value = .., unit = "electron / adu" }',
    ),
    "a parameter of a detector misspelt": (
        section("mission.overrides", '"vis.readnoise@3-4" = 3.5'),
        "mission.overrides.vis.readnoise@3-4 = 3.5: no parameter vis.readnoise exists",
        'write "vis.read_noise@3-4" = { value = 3.5, unit = "electron" }',
    ),
    "a parameter without a camera": (
        section("mission.overrides", "read_noise = 3.5"),
        "mission.overrides.read_noise = 3.5: no parameter read_noise exists",
        "did you mean vis.read_noise, nisp.read_noise or ext.hsc.read_noise?",
    ),
    "a parameter of no similar name": (
        section("mission.overrides", '"vis.qe" = 0.9'),
        "mission.overrides.vis.qe = 0.9: no parameter vis.qe exists",
        "truesky mission list prints all names",
    ),
    "a parameter misspelt in another section": (
        section("mission", '"vis.readnoise" = 3.5'),
        "mission.vis.readnoise is not a key",
        'as "vis.read_noise" = { value = 3.5, unit = "electron" } (no parameter vis.readnoise exists; did you',
    ),
    "a negative parameter": (
        section("mission.overrides", '"vis.read_noise" = { value = -3, unit = "electron" }'),
        "mission.overrides.vis.read_noise [electron] = -3",
        "[0.0, ",
    ),
    "a quadrant without gain": (
        section("mission.overrides", '"vis.gain@3-4.E" = { value = 0.0, unit = "electron / adu" }'),
        "mission.overrides.vis.gain@3-4.E [electron / adu] = 0.0",
        "is outside [0.001, 1000.0]",
    ),
    "a quadrant with an unknown gain": (
        section("mission.overrides", '"vis.gain@3-4.E" = { value = nan, unit = "electron / adu" }'),
        "mission.overrides.vis.gain@3-4.E.value = nan",
        "is not a finite number",
    ),
    "ageing that is negative": (
        section("mission.overrides", '"vis.cti.age_growth" = { value = -0.1, unit = "1 / yr" }'),
        "mission.overrides.vis.cti.age_growth [1 / yr] = -0.1",
        "is outside [0.0, 10.0]",
    ),
    "a wrong unit": (
        section("mission.overrides", '"vis.gain" = { value = 3.0, unit = "mm" }'),
        "mission.overrides.vis.gain: the unit must be electron / adu",
        "got mm",
    ),
    "a unit in capitals": (
        section("mission.overrides", '"vis.read_noise" = { value = 5.0, unit = "ADU" }'),
        "mission.overrides.vis.read_noise: 'ADU' is not a unit: ",
        "the unit must be electron or a unit that converts to it",
    ),
    "a list of values": (
        section("explore", '"vis.gain" = [3.0, 3.5]'),
        "explore.vis.gain",
        "{ values = .., unit = .. }",
    ),
    "a file instead of a table": (
        section("stars", 'catalogue = "g.csv"'),
        "stars.catalogue",
        "{ file = .., columns = .. }",
    ),
    "a parameter of [explore] without quotes": (
        section("explore", 'vis.gain = { values = [3.0], unit = "electron / adu" }'),
        "explore.vis: write the name in quotes",
        'such as "vis.gain" = { values = [..], unit = ".." }',
    ),
    "an effect of [explore] without quotes": (
        section("explore", "effects.cosmic_rays = [true, false]"),
        "explore.effects: write the name in quotes",
        'such as "effects.cosmic_rays" = [true, false]',
    ),
    "arms of a word": (section("structure", 'arms = "yes"'), "structure.arms", "must be true or a table such as"),
    "a passband without a format": (
        section("fluxes.passbands.x", 'file = "x.dat"\nmedium = "air"'),
        "fluxes.passbands.x.format is missing",
        'such as "passband_ascii" (docs/own_files.md)',
    ),
    "a map without a column": (
        section("ingest.dust", 'file = "x.fits"'),
        "ingest.dust.column",
        "the column with the map",
    ),
    "a survey as channel": (changed('"VIS"', '"LSST"'), "pointing[0].channel", "did you mean EXT? allowed: VIS"),
    "lensing off": (
        section("universe", 'lensing = "off"'),
        "universe.lensing",
        "did you mean none? allowed: box, none",
    ),
    "truth without noise": (section("products", 'truth = ["noiseless"]'), "products.truth", "did you mean noise_free?"),
    "a date of an observation": (EUCLID + 'date = "2027-11-20"\n', "observation[0].date", "did you mean mjd?"),
    "a band of the stars' limit": (
        section("universe", 'star_band = "gaia_g"'),
        "universe.star_band is not a key of a request; star_limit is always in H (Vega); ",
        "allowed here: alignment, box_cells",
    ),
    "H0 in the universe": (
        section("universe", "H0 = 70"),
        "universe.H0 is not a key of a request; it is h = H0 / 100 in [universe.cosmology]; ",
        "cosmology",
    ),
    "a parameter of the cosmology in the universe": (
        section("universe", "omega_m = 0.3"),
        "universe.omega_m is not a key of a request; ",
        "it belongs in [universe.cosmology]",
    ),
    "another name of sigma_8": (
        section("universe.cosmology", "sigma8 = 0.8"),
        "universe.cosmology.sigma8 is not a key of a request; ",
        "did you mean sigma_8?",
    ),
    "a curved universe": (
        section("universe.cosmology", "omega_lambda = 0.7"),
        "universe.cosmology.omega_lambda is not a key of a request; ",
        "the universe is flat: give omega_m",
    ),
    "H0 as h": (section("universe.cosmology", "h = 67.4"), "universe.cosmology.h = 67.4", "did you mean 0.674?"),
    "an unknown truth without brackets": (
        section("products", 'truth = "noiseless"'),
        "products.truth must be a list of texts such as ['noise_free'] (allowed: noise_free, ",
        "got 'noiseless'",
    ),
    "a truth of no known name without brackets": (
        section("products", 'truth = "qqqq"'),
        "such as ['noise_free'] (allowed: noise_free, ",
        "got 'qqqq'",
    ),
    "a band of the fluxes": (
        section("fluxes", 'band = ["euclid_y"]'),
        "fluxes.band is not a key of a request; ",
        "did you mean bands? allowed",
    ),
    "a band that a survey has not": (
        GROUND + 'bands = ["lsst_x"]\n',
        "survey lsst has no band 'lsst_x': ",
        "allowed with lsst: lsst_u, lsst_g",
    ),
    "a flat list of vertices": (
        area("polygon = [150.0, 2.0, 150.3, 2.0, 150.3, 2.3]"),
        "area.polygon must be",
        "write [[150.0, 2.0], ..]",
    ),
    "a flat list of circles": (area("patches = [150.0, 2.0, 0.3]"), "area.patches", "write [[150.0, 2.0, 0.3], ..]"),
    "a large shear": (section("universe", "lensing = { g1 = 2.0, g2 = 0 }"), "universe.lensing.g1 = 2", "[-0.9, 0.9]"),
    "any noise": (
        section("effects", 'off = ["noise"]'),
        "effects.off: 'noise' is not allowed: ",
        "did you mean poisson, read_noise, group_noise or injection_noise?",
    ),
    "an explored accuracy without brackets": (
        section("explore", 'accuracy = "survey"'),
        "explore.accuracy must be a list",
        'write ["survey"]',
    ),
    "an explored effect without brackets": (
        section("explore", '"effects.poisson" = true'),
        "explore.effects.poisson must be a list",
        "write [true]",
    ),
    "columns of no catalogue": (
        section("ingest.columns", 'ra = "RA"'),
        "ingest.columns is not a key of a request; ",
        "did you mean [ingest.galaxies.columns]?",
    ),
    "files of no catalogue": (
        section("ingest", 'files = ["x.csv"]'),
        "ingest.files is not a key",
        "it belongs in [ingest.galaxies]",
    ),
    "a hyphen in the name of a passband": (
        section("fluxes.passbands.my-g", 'file = "x.dat"\nmedium = "air"\nformat = "passband_ascii"'),
        "fluxes.passbands.my-g: a name has only letters, digits and _: ",
        "write my_g",
    ),
    "one file": (section("ingest.galaxies", 'file = "x.parquet"'), "ingest.galaxies.file", "did you mean files?"),
}


@pytest.mark.parametrize(("text", "key", "remedy"), MISTAKES.values(), ids=MISTAKES)
def test_one_line_names_the_key_and_the_remedy(tmp_path, text, key, remedy):
    (tmp_path / "x.dat").touch()
    (line,) = read_valid_parts(tomllib.loads(text), tmp_path).messages
    assert key in line
    assert remedy in line
    assert len(line) <= 1000


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            section("effects", 'off = ["cosmic rays"]'),
            "effects.off: 'cosmic rays' is not allowed: did you mean cosmic_rays?",
        ),
        (section("univers", "z_max = 2.0"), "univers is not a key of a request; did you mean [universe]?"),
        (
            changed('["3-4"]', '["3-7"]'),
            "pointing[0].detectors: camera vis has no detector '3-7': did you mean 3-6 or 3-5",
        ),
    ],
)
def test_after_a_suggestion_long_lists_are_left_out(tmp_path, text, line):
    (message,) = read_valid_parts(tomllib.loads(text), tmp_path).messages
    assert message.startswith(line)
    assert message.endswith("?")


def test_all_wrong_values_of_parameters_are_reported_in_the_order_of_the_file(tmp_path):
    lines = (
        '"vis.readnoise" = { value = 3.5, unit = "electron" }\n"vis.gain" = 3.5\nvis.biass = 1\nvis.full_well = 1\n'
        '"vis.read_noise" = { value = 3.5, unit = "mm" }\n"vis.bias@9-9" = { value = 1, unit = "adu" }'
    )
    messages = read_valid_parts(tomllib.loads(section("mission.overrides", lines)), tmp_path).messages
    names = [message.removeprefix("mission.overrides.").split(" ")[0].rstrip(":") for message in messages]
    wrong = ["vis.readnoise", "vis.gain", "vis.biass", "vis.full_well", "vis.read_noise"]
    assert names == [*wrong, "vis.bias@9-9"]


def test_a_wrong_unit_does_not_hide_an_unknown_detector(tmp_path):
    line = '"vis.dark_current@34" = { value = 1, unit = "mm" }'
    messages = read_valid_parts(tomllib.loads(section("mission.overrides", line)), tmp_path).messages
    assert ["the unit must be" in text for text in messages] == [True, False]
    assert "vis has no detector '34'" in messages[1]


def test_there_are_more_than_60_mistakes():
    assert len(MISTAKES) > 60


@pytest.mark.parametrize("text", [GOOD, EUCLID, GROUND])
def test_requests_without_a_mistake_are_valid(tmp_path, text):
    assert read_valid_parts(tomllib.loads(text), tmp_path).messages == ()


def test_all_mistakes_of_a_passband_are_reported_each_with_its_line(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text(GOOD + '[fluxes.passbands.my_g]\nfile = "my_g.dat"\nformat = "ascii"\n')
    with pytest.raises(BadInput) as caught:
        parse(file)
    assert caught.value.messages == (
        f"request {file} line 13: fluxes.passbands.my_g.file: {tmp_path / 'my_g.dat'}: no such file",
        f"request {file} line 14: fluxes.passbands.my_g.format = 'ascii' is not allowed: "
        "did you mean passband_ascii? allowed: passband_ascii, passband_ecsv, passband_svo",
        f"request {file} line 12: fluxes.passbands.my_g.medium is missing: it must be one of air, vacuum",
    )
