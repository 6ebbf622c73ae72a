"""Identify the effects that explain the differences, and what no effect explains.

`forward_search.identify_effects` calls the others. In the order of their work:

- `examination`: the record, its candidates, and the threshold that null records give;
- `components`: the rows of statistics in which a candidate shows, and their evidence together;
- `selections`: what the search puts into the model, an effect or a nuisance alternative;
- `naming_order` and `identifiability`: which effect comes first, and what competes with it;
- `settling` and `withdrawal`: each selection again, with all others in the model;
- `identifications`: the result; `forms` chooses one of several forms that explain it equally;
- `late_channels`: the channel that would explain more if it were moved in time.
"""
