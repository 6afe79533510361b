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

/** @returns null where nothing of a tileset was hit */
export function inspect(picked) {
  const content = picked?.content;
  const tile = content?.tile;
  if (!tile) return null;
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
    metadata: properties(tile.metadata),
  };
}
