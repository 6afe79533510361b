// What is known of the tile and the feature under a pixel, as plain values.

/** CesiumJS hands out its own vectors and typed arrays: makes numbers, strings and arrays of them. */
function plain(value) {
  if (typeof value === 'bigint') return Number(value);
  if (value === null || typeof value !== 'object') return value;
  if (Array.isArray(value) || ArrayBuffer.isView(value)) return Array.from(value, plain);
  return ['x', 'y', 'z', 'w'].filter((axis) => axis in value).map((axis) => value[axis]);
}

/** The properties of a tile's metadata: id → { value, what }, `what` being the schema's description. */
function properties(metadata) {
  const ids = metadata?.getPropertyIds() ?? [];
  return Object.fromEntries(ids.map((id) => [id, { value: plain(metadata.getProperty(id)), what: metadata.class?.properties?.[id]?.description ?? '' }]));
}

/**
 * Splits properties into those of the tile and those of each class. A class's are named as `roofBound`, or are arrays
 * with one value a class: both become perClass.bound.roof.
 */
function split(all, names) {
  const ofTile = {}, perClass = {};
  const bare = names.map((name) => String(name).replace(/[^a-z0-9]/gi, '').toLowerCase());
  for (const [id, property] of Object.entries(all)) {
    const { value, what } = property;
    if (value === undefined || value === null) continue;
    // The longest name wins: `roofEdgeBound` is of `roof edge` where there is such a class.
    const owner = bare.reduce((best, name, i) => (id.toLowerCase().startsWith(name) && /^[A-Z_]/.test(id.slice(name.length)) && name.length > (bare[best]?.length ?? 0) ? i : best), -1);
    const measure = owner < 0 ? id : id.slice(bare[owner].length).replace(/^_/, '').replace(/^[A-Z]/, (letter) => letter.toLowerCase());
    const values = owner >= 0 ? { [names[owner]]: value } : Array.isArray(value) && names.length > 1 && value.length === names.length ? Object.fromEntries(names.map((name, i) => [name, value[i]])) : null;
    if (values) (perClass[measure] ??= { what: what.replace(/^[^:]*: /, ''), values: {} }, Object.assign(perClass[measure].values, values));
    else ofTile[id] = property;
  }
  return { ofTile, perClass };
}

/** @param names the classes known; @returns null where nothing of a tileset was hit */
export function inspect(picked, names) {
  const content = picked?.content;
  const tile = content?.tile;
  if (!tile) return null;
  const { ofTile, perClass } = split(properties(tile.metadata), names);
  let level = 0;
  for (let parent = tile.parent; parent; parent = parent.parent) level++;
  const feature = picked.getPropertyIds ? Object.fromEntries(picked.getPropertyIds().map((id) => [id, plain(picked.getProperty(id))])) : {};
  return {
    class: feature.class ?? null,
    feature,
    uri: decodeURIComponent(new URL(content.url, location.href).pathname.slice(1)),
    level,
    geometricError: tile.geometricError,
    triangles: content.trianglesLength,
    metadata: ofTile,
    perClass,
  };
}
