// Whole frames of two methods as they play: small and with loss.

// A source of the player. Each method is one image with all frames in rows, decoded on demand.
class Sheets {
  constructor(info) {
    Object.assign(this, info); // width, height, columns, frames, sources: see embed_animations
    this.decoded = new Map();
  }

  size() {
    return this;
  }

  label(source) {
    return [this.sources[source].name];
  }

  async image(source, { frame }) {
    if (!this.decoded.has(source)) {
      const image = new Image();
      image.src = "data:image/webp;base64," + find(`a${source}`).textContent;
      this.decoded.set(source, image.decode().then(() => image));
    }
    const { width, height, columns } = this, cut = makeCanvas(width, height);
    cut.getContext("2d").drawImage(await this.decoded.get(source), -(frame % columns) * width, -Math.floor(frame / columns) * height);
    return cut;
  }
}

function startAnimations(info) {
  const sheets = new Sheets(info), names = sheets.sources.map(({ name }) => name);
  const player = new Player(sheets, { prefix: "animation-", state: firstPair(names) });
  fillChoices(player, names);
  player.listen({ wheelNeedsFocus: true });
  player.listenToKeys(find("animations"));
  find("animations").hidden = false;
  return matchMedia("(prefers-reduced-motion: reduce)").matches ? player.draw() : player.play(true);
}
