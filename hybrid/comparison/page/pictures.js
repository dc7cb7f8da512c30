// Pictures and maps of the page, encoded by hybrid/comparison/embedding.py.

// Codes of all pictures, each decoded on demand. Source 0 is the reference.
class Pictures {
  constructor(info) {
    Object.assign(this, info); // width, height, origin, frames, sources …: see embed_pictures
    this.count = this.width * this.height;
    this.lost = this.codes - 1; // the code of a value that is not finite
    this.radiance = Float64Array.from({ length: this.codes }, (_, code) =>
      code === this.lost ? NaN : this.black * (2 ** (code / this.codesPerStop) - 1));
    this.decoded = new Map();
  }

  // Planes of red, green and blue codes, one after the other.
  colors(source, frame) {
    return this.planes(`p${source}-${frame}`, 3, this.codes);
  }

  // Levels of a map; null where the source has none of this title, or none of this frame.
  map(source, title, frame) {
    const id = `m${source}-${this.sources[source].maps.indexOf(title)}-${frame}`;
    return document.getElementById(id) ? this.planes(id, 1, this.mapLevels) : null;
  }

  planes(id, channels, levels) {
    if (!this.decoded.has(id)) this.decoded.set(id, this.decode(id, channels, levels));
    return this.decoded.get(id);
  }

  async decode(id, channels, levels) {
    const folded = await inflate(find(id).textContent);
    const planes = undoPrediction(folded, channels, this.width, this.height, levels);
    return channels === 3 ? undoColorDifferences(planes, this.count, levels) : planes;
  }
}

async function inflate(base64) {
  const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Each value is stored as its difference to a prediction from the pixels left, above and above left; low bytes first.
function undoPrediction(folded, channels, width, height, levels) {
  const total = channels * width * height, mask = levels - 1;
  const out = new Uint16Array(total);
  for (let c = 0, i = 0; c < channels; c++) {
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++, i++) {
        const above = y ? out[i - width] : 0;
        const left = x ? out[i - 1] : above;
        const corner = x ? (y ? out[i - width - 1] : 0) : (y > 1 ? out[i - 2 * width] : 0);
        const small = Math.min(left, above), large = Math.max(left, above);
        const guess = corner >= large ? small : corner <= small ? large : left + above - corner;
        const rest = folded[i] | (folded[total + i] << 8);
        out[i] = (guess + (rest & 1 ? -((rest + 1) >> 1) : rest >> 1)) & mask;
      }
    }
  }
  return out;
}

// From green, red − green and blue − green to red, green and blue.
function undoColorDifferences(planes, count, levels) {
  const mask = levels - 1, half = levels >> 1;
  for (let i = 0; i < count; i++) {
    const green = planes[i], red = planes[count + i], blue = planes[2 * count + i];
    planes[i] = (red + green - half) & mask;
    planes[count + i] = green;
    planes[2 * count + i] = (blue + green - half) & mask;
  }
  return planes;
}
