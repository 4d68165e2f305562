// Suggestions for plots: tables and joins, their columns, and first charts.

import * as api from "/static/api.js";

/** Tables, and joins of related tables. */
export function sources() {
  const names = api.lake.tables.map((table) => table.name);
  const joined = [["galaxies", "galaxy_fluxes"], ["stars", "star_fluxes"]].filter((pair) => pair.every((name) => names.includes(name)));
  return [...names.map(api.sqlName), ...joined.map(([a, b]) => `${a} JOIN ${b} USING (id)`)];
}

/** Expressions of the axes of the first charts. */
export function suggested(rows) {
  if (rows.startsWith("galaxies")) {
    const flux = rows.includes("galaxy_fluxes") ? columnsOf(rows).find((c) => c.name.startsWith("f_nu_")) : null;
    const mag = flux && `mag_ab(${api.sqlWord(flux.name)})`;
    return flux ? [["z_obs"], [mag], ["color_gr_01"], [mag, "color_gr_01"]]
      : [["z_obs"], ["mag_r01"], ["color_gr_01"], ["log_stellar_mass"], ["z_obs", "mag_r01"], ["abs_mag_r01", "color_gr_01"]];
  }
  const numbers = columnsOf(rows).filter((c) => /int|float|double/.test(c.type) && !/^list|(^|_)id$|^_healpix/.test(`${c.type}`) && !/(^|_)id$|^_healpix/.test(c.name)).map((c) => api.sqlQuoted(c.name));
  return [...numbers.slice(0, 4).map((name) => [name]), ...(numbers.length > 1 ? [numbers.slice(0, 2)] : [])];
}

/** Columns of all tables in a FROM clause. */
export function columnsOf(rows) {
  return api.lake.tables.filter((table) => new RegExp(`(^|[^\\w.])${table.name}($|[^\\w])`).test(rows.replaceAll('"', ""))).flatMap((table) => table.columns);
}
