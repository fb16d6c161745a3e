/* The search of the site (html_search_scorer). A page answers a query as far as
 *   its best phrase, a title, heading, index entry or name, says the same: the cosine of the words of both, each weighted
 *   by its rarity log(1 + pages / pages with it) (K. Sparck Jones, Journal of Documentation 28, 11, 1972);
 *   the rarities of the query's words are in any of its phrases, and in its text, as parts of their sum;
 *   less what stands before pages that only use the words: API entries, theory, examples. */
const PHRASES = {title: 1, entry: 1, section_entry: 0.9, heading: 0.65, object: 0.65}, IN_PHRASES = 0.75, IN_TEXT = 0.4;
const SUPPORTING = {
  reference: 0.4, extending: 0.3, faq: 0.3, gallery: 0.3, notebooks: 0.3, coming_from: 0.3, theory: 0.2, glossary: 0.1,
};
const KINDS = {title: "title", entry: "index", section_entry: "index", heading: "title", object: "object"};

const plain_words = (text) =>
  splitQuery(text.toLowerCase()).filter((word) => !stopwords.has(word) && !/^\d+$/.test(word));
const stem = (word) => new Stemmer().stemWord(word);
const section = (name) => (name.endsWith("/index") ? "" : /^coming_from|^[^/_]*/.exec(name)[0]);
const total = (values) => values.reduce((sum, value) => sum + value, 0);

class Pages {
  constructor({docnames, titles, terms, titleterms, alltitles, indexentries, objects}) {
    Object.assign(this, {docnames, titles, with_word: new Map()});
    for (const [word, pages] of [...Object.entries(terms), ...Object.entries(titleterms)])
      this.with_word.set(word, new Set([...(this.with_word.get(word) ?? []), ...[pages].flat()]));
    this.phrases = docnames.map(() => []);
    const add = (page, kind, text, anchor) =>
      this.phrases[page].push({kind, text, anchor, words: new Set(plain_words(text).map(stem))});
    for (const [text, places] of Object.entries(alltitles))
      for (const [page, id] of places) add(page, titles[page] === text ? "title" : "heading", text, id ? `#${id}` : "");
    for (const [text, places] of Object.entries(indexentries))
      for (const [page, id] of places) add(page, id ? "section_entry" : "entry", text, id ? `#${id}` : "");
    for (const [prefix, names] of Object.entries(objects))
      for (const [page, , , , name] of names) add(page, "object", name, `#${prefix}.${name}`);
    this.in_phrases = this.phrases.map((phrases) => new Set(phrases.flatMap(({words}) => [...words])));
  }

  rarity = (word) => Math.log(1 + this.docnames.length / (this.with_word.get(word)?.size || 1));

  /* Words of a query; one that no page has is joined with the next ("leap frog"), divided ("timestep"), or completed. */
  words_of(query) {
    const known = (word) => this.with_word.has(word);
    return [...new Set(plain_words(query).flatMap((word, k, all) => {
      const [one, next, joined] = [word, all[k + 1] ?? "", word + (all[k + 1] ?? "")].map(stem);
      if (known(one) && (known(next) || !known(joined))) return [one];
      const cuts = [...word].map((_, cut) => [stem(word.slice(0, cut)), stem(word.slice(cut))]).slice(3, -2);
      const completed = [...this.with_word.keys()].find((other) => other.startsWith(one));
      return [[joined], ...cuts].find((words) => words.every(known)) ?? [completed ?? one];
    }))];
  }

  found(query) {
    const words = this.words_of(query), rarity = new Map(words.map((word) => [word, this.rarity(word)]));
    const length = (all) => Math.hypot(...[...all].map((word) => rarity.get(word) ?? this.rarity(word)));
    const whole = total([...rarity.values()]);
    const part = (has) => total(words.map((word) => has(word) * rarity.get(word))) / whole;
    return this.docnames.flatMap((name, page) => {
      const likeness = ({words: said, kind}) => {
        const common = words.filter((word) => said.has(word));
        return common.length && (PHRASES[kind] * length(common) ** 2) / length(words) / length(said);
      };
      const best = this.phrases[page].map((phrase) => ({phrase, likeness: likeness(phrase)}))
        .reduce((one, other) => (other.likeness > one.likeness ? other : one), {likeness: 0});
      const text = part((word) => this.with_word.get(word)?.has(page) ?? false);
      const score = best.likeness + IN_PHRASES * part((word) => this.in_phrases[page].has(word)) + IN_TEXT * text;
      return score ? [{page, score: score - (SUPPORTING[section(name)] ?? 0), ...best.phrase}] : [];
    });
  }
}

var Scorer = {};
if (typeof Search !== "undefined") {
  let pages = null;
  Search._performSearch = (query) => {
    document.getElementById("search-progress")?.replaceChildren();
    pages ??= new Pages(Search._index);
    const results = pages.found(query).sort((one, other) => one.score - other.score);
    return results.map(({page, score, kind, text, anchor}) => [
      pages.docnames[page], pages.titles[page], anchor ?? "", kind && kind !== "title" ? text : null, score,
      Search._index.filenames[page], KINDS[kind] ?? "text",
    ]);
  };
}
