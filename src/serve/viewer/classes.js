// Which classes the tileset has and how they are coloured.

const COLOURS = { terrain: '#a67c52', facade: '#d04038', roof: '#3a68be', clutter: '#569e4a' };
// For classes that are not ours: told apart from ours and, as far as six can be, from each other.
const MORE = ['#e0b23c', '#8d5bb5', '#3fb6b0', '#e07fae', '#9aa3ad', '#c7d36f'];
const OTHER = '#d8dde3';
// Enough features to meet every class of a tile; a tile with a feature per region may have thousands.
const FEATURES_READ = 4096;

/** CesiumJS mixes a style's colour in as if it were linear light: gives the linear one, so that the sRGB one comes out. */
function linear(colour) {
  const bytes = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  return `#${bytes.map((b) => Math.round(255 * (b / 255) ** 2.2).toString(16).padStart(2, '0')).join('')}`;
}

export class Classes {
  /** name → colour, in the order in which they became known. */
  colours = new Map();

  /** Takes the names of the enum of classes in a tileset's schema, so that order and legend do not depend on loading. */
  readSchema(schema) {
    const enums = Object.entries(schema?.enums ?? {});
    const found = enums.find(([id, e]) => /class/i.test(id) || e.values.some((v) => v.name.toLowerCase() in COLOURS));
    return found ? this.#add(found[1].values.map((v) => v.name)) : false;
  }

  /** Takes the names in use in a tile's features; true if there was a new one. */
  readTile(content) {
    const contents = content.innerContents ?? [content];
    const names = new Set();
    for (const inner of contents) {
      for (let i = 0; i < Math.min(inner.featuresLength, FEATURES_READ); i++) {
        const name = inner.getFeature(i).getProperty('class');
        if (name !== undefined) names.add(name);
      }
    }
    return this.#add([...names].sort());
  }

  #add(names) {
    const before = this.colours.size;
    for (const name of names) {
      if (this.colours.has(name)) continue;
      const others = [...this.colours.keys()].filter((n) => !(String(n).toLowerCase() in COLOURS)).length;
      this.colours.set(name, COLOURS[String(name).toLowerCase()] ?? MORE[others % MORE.length]);
    }
    return this.colours.size > before;
  }

  /** A style that paints every feature in the colour of its class. */
  style() {
    const is = (name) => '${class} === ' + (typeof name === 'number' ? name : `'${String(name).replace(/[\\']/g, '\\$&')}'`);
    const conditions = [...this.colours].map(([name, colour]) => [is(name), `color('${linear(colour)}')`]);
    return new Cesium.Cesium3DTileStyle({ color: { conditions: [...conditions, ['true', `color('${linear(OTHER)}')`]] } });
  }
}
